// @ts-check
/** Requests to the service. Their paths are relative to the page, which a proxy may offer below a subpath. */
import { words } from "./words.js";

/** Error answer of the service, with its message. */
export class Problem extends Error {
  /** @param {number} status @param {any} body body of the answer */
  constructor(status, body) {
    super(typeof body?.detail === "string" ? body.detail : words.api.status(status));
    this.status = status;
    this.code = String(body?.code ?? "");
    /** @type {string | undefined} */
    this.input = body?.input;
    /** @type {{at: string, message: string}[]} */
    this.errors = body?.errors ?? [];
    this.body = body ?? {};
  }
}

/** Error of a service that cannot be reached. */
export class Unreachable extends Error {
  constructor() {
    super(words.api.unreachable);
  }
}

/** Event of the window after an answer that requires a key. */
export const KEY_NEEDED = "sgsst-key-needed";

/**
 * Send a request, and return its answer if it is not an error.
 *
 * @param {string} method
 * @param {string} path
 * @param {{body?: BodyInit, json?: any, headers?: Record<string, string>, signal?: AbortSignal}} [more]
 * @throws {Problem | Unreachable | DOMException}
 */
export async function ask(method, path, { body, json, headers = {}, signal } = {}) {
  let answer;
  const sent = json === undefined ? body : JSON.stringify(json);
  /** @type {Record<string, string>} */
  const kind = json === undefined ? {} : { "Content-Type": "application/json" };
  try {
    answer = await fetch(path, { method, body: sent, headers: { ...kind, ...headers }, signal, credentials: "same-origin" });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new Unreachable();
  }
  if (answer.ok) return answer;
  const told = await answer.json().catch(() => null);
  if (answer.status === 401 && path !== "v1/session") dispatchEvent(new Event(KEY_NEEDED));
  throw new Problem(answer.status, told);
}

/** @param {string} path @param {AbortSignal} [signal] @returns {Promise<any>} */
export const get = async (path, signal) => (await ask("GET", path, { signal })).json();

/** Yield the events of an answer that is an event stream. @param {Response} answer @returns {AsyncGenerator<{event: string, data: any}>} */
export async function* eventsOf(answer) {
  const reader = /** @type {ReadableStream<Uint8Array>} */ (answer.body).pipeThrough(/** @type {any} */ (new TextDecoderStream())).getReader();
  let kept = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    kept += value;
    const parts = kept.split("\n\n");
    kept = parts.pop() ?? "";
    for (const part of parts) {
      const line = (/** @type {string} */ name) => part.split("\n").find((each) => each.startsWith(`${name}: `))?.slice(name.length + 2);
      const data = line("data");
      if (data) yield { event: line("event") ?? "message", data: JSON.parse(data) };
    }
  }
}

/** Return the path of a job's artifact. @param {string} id @param {string} name */
export const artifactPath = (id, name) => `v1/jobs/${encodeURIComponent(id)}/artifacts/${name.split("/").map(encodeURIComponent).join("/")}`;

/** Return a random key; works in insecure contexts too, where `crypto.randomUUID` is missing. */
export const randomKey = () => Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
