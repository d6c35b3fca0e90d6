// @ts-check
/** Worker that reads a scene as it arrives, passes it on in batches, and sorts it for the viewer. */
import { ByteReader, CutError, SceneError } from "./byte_reader.js";
import { depthOrder } from "./depth_order.js";
import { harmonicTexels, pack } from "./packing.js";
import { openScene } from "./scene_file.js";
import { rgbOf, Selector } from "./selector.js";
import { words } from "../words.js";

/** @typedef {import("./scene_file.js").SceneFile} SceneFile */

const port = /** @type {any} */ (self);
let centers = new Float32Array(0), reach = new Float32Array(0), colors = new Uint8ClampedArray(0), count = 0, degree = 0;
/** @type {Selector | undefined} */
let selector;

port.onmessage = async (/** @type {MessageEvent} */ { data }) => {
  if (data.kind === "sort") {
    const order = depthOrder(centers, reach, count, data.pose);
    port.postMessage({ kind: "order", order, number: data.number, of: count }, [order.buffer]);
  } else if (data.kind === "center") {
    port.postMessage({ kind: "center", center: [...centers.subarray(3 * data.index, 3 * data.index + 3)] });
  } else if (data.kind === "select") {
    selector ??= new Selector(centers, reach, colors, middle().radius);
    port.postMessage({ kind: "selected", ...selector.answer(data) });
  } else if (data.kind === "load") {
    try {
      await load(data.source, data.room);
    } catch (error) {
      const message = error instanceof SceneError ? error.message : words.scene.unreadable; // also if values are missing
      port.postMessage({ kind: "failed", message, cut: error instanceof CutError });
    }
  }
};

/** @param {File | string} source @param {{texels: number, bytes: number}} room of a texture, and of all textures */
async function load(source, room) {
  const [stream, size] = await opened(source), reader = new ByteReader(stream);
  const file = await openScene(reader, size);
  degree = keptDegree(file, room);
  centers = new Float32Array(file.count * 3);
  reach = new Float32Array(file.count);
  colors = new Uint8ClampedArray(file.count * 3);
  port.postMessage({ kind: "header", header: { count: file.count, degree: file.degree, size, rendering: file.rendering, front: file.front }, degree });
  for await (const rows of file.batches()) give(rows, file);
  reader.end();
  port.postMessage({ kind: "done", middle: middle() });
}

/** @param {File | string} source @returns {Promise<[ReadableStream<Uint8Array>, number]>} */
async function opened(source) {
  if (source instanceof Blob) return [source.stream(), source.size];
  const answer = await fetch(source, { credentials: "same-origin" });
  if (!answer.ok || !answer.body) throw new SceneError(words.scene.notThere);
  return [answer.body, answer.headers.has("content-encoding") ? 0 : Number(answer.headers.get("content-length") ?? 0)];
}

/** Return the highest SH degree that fits. @param {SceneFile} file @param {{texels: number, bytes: number}} room */
function keptDegree(file, { texels, bytes }) {
  const fits = (/** @type {number} */ d) => {
    const each = harmonicTexels(d);
    return file.count * Math.max(each, 2) <= texels && file.count * (48 + 16 * each) <= bytes;
  };
  let kept = file.degree;
  while (kept > 0 && !fits(kept)) kept--;
  if (file.count * 2 > texels) throw new SceneError(words.scene.tooMany(file.count));
  return kept;
}

/** @param {Float32Array} rows @param {SceneFile} file */
function give(rows, file) {
  const packed = pack(rows, file.width, file.at, file.degree, degree);
  centers.set(packed.centers, count * 3);
  reach.set(packed.reach, count);
  colors.set(rgbOf(rows, file.width, file.at), count * 3);
  const begin = count;
  count += packed.reach.length;
  const { geometry, harmonics } = packed;
  const first = begin === 0 ? middle() : undefined;
  port.postMessage({ kind: "batch", begin, count: count - begin, geometry, colors: packed.colors, harmonics, middle: first },
    [geometry.buffer, packed.colors.buffer, harmonics.buffer]);
}

/** Return the bounds of the Gaussians without outliers. @returns {import("./splat_scene.js").Middle} */
function middle() {
  const step = Math.max(1, Math.floor(count / 20000));
  /** @type {number[]} */
  const picked = [];
  for (let i = 0; i < count; i += step) if (reach[i] > 0) picked.push(i);
  const along = [0, 1, 2].map((axis) => Float64Array.from(picked, (i) => centers[3 * i + axis]).sort());
  const quantile = (/** @type {ArrayLike<number>} */ values, /** @type {number} */ share) => values[Math.floor(share * (values.length - 1))] ?? 0;
  const center = along.map((values) => quantile(values, 0.5));
  const away = Float64Array.from(picked, (i) => Math.hypot(...center.map((c, axis) => centers[3 * i + axis] - c))).sort();
  return {
    center, radius: Math.max(quantile(away, 0.9), 1e-6),
    low: along.map((values) => quantile(values, 0.05)), high: along.map((values) => quantile(values, 0.95)),
  };
}
