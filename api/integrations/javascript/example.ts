// Stylize a scene: node example.js scene.ply painting.jpg stylized.ply
// Let it follow a painted view: node example.js scene.ply painted.png painted.ply orbit_0000
import { readFile, writeFile } from "node:fs/promises";
import { basename } from "node:path";
import { setTimeout } from "node:timers/promises";
import createClient from "openapi-fetch";
import type { components, paths } from "./schema.js";

const [scene = "", image = "", out = "", view = ""] = process.argv.slice(2);
const key = process.env.SGSST_KEY;
const service = createClient<paths>({
  baseUrl: process.env.SGSST_URL ?? "http://127.0.0.1:8000",
  redirect: "error", // the key is for this address alone
  headers: key ? { Authorization: `Bearer ${key}` } : {},
});
const parameters: Partial<components["schemas"]["JobParameters"]> = view ? { orbit: 24, painted: [{ view, camera: null }] } : { preset: "preview", orbit: 24 };
const form = new FormData();
form.append("scene", new Blob([await readFile(scene)]), basename(scene));
form.append(view ? "painted" : "style", new Blob([await readFile(image)]), basename(image));
form.append("parameters", JSON.stringify(parameters));
const submitted = await service.POST("/v1/jobs", { body: form as never, bodySerializer: () => form });
if (submitted.error) throw new Error(submitted.error.detail);
if (!("id" in submitted.data)) throw new Error("The service planned the job without queueing it.");
const path = { job_id: submitted.data.id };
for (;;) {
  const { data: job, error, response } = await service.GET("/v1/jobs/{job_id}", { params: { path } });
  if (error) throw new Error(error.detail);
  console.log(job.status, job.progress?.stage ?? "", job.progress?.fraction ?? 0);
  if (job.status === "succeeded") break;
  if (job.error || job.status === "canceled") throw new Error(job.error?.message ?? job.status);
  await setTimeout(1000 * Number(response.headers.get("Retry-After") ?? 1));
}
const params = { path: { ...path, name: "stylized.ply" } };
const result = await service.GET("/v1/jobs/{job_id}/artifacts/{name}", { params, parseAs: "arrayBuffer" });
if (!result.data) throw new Error("The result could not be downloaded. Try again.");
await writeFile(out, new Uint8Array(result.data as ArrayBuffer));
