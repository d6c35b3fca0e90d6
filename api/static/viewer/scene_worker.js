// @ts-check
/** Reads a scene as it arrives, hands it over in batches, and sorts it for the viewer. */
import { depthOrder } from "./depth_order.js";
import { BATCH, pack } from "./packing.js";
import { LONGEST_HEADER, readHeader, Rows, SceneError } from "./ply.js";
import { words } from "../words.js";

/** @typedef {import("./ply.js").Header} Header */

const port = /** @type {any} */ (self);
let centres = new Float32Array(0), reach = new Float32Array(0), count = 0, degree = 0;

port.onmessage = async (/** @type {MessageEvent} */ { data }) => {
  if (data.kind === "sort") {
    const order = depthOrder(centres, reach, count, data.pose);
    port.postMessage({ kind: "order", order, number: data.number, of: count }, [order.buffer]);
  } else if (data.kind === "load") {
    try {
      await load(data.source, data.room);
    } catch (error) {
      const told = error instanceof SceneError ? error.message : words.scene.unreadable;
      port.postMessage({ kind: "failed", message: told, detail: String(error) });
    }
  }
};

/**
 * @param {File | string} source
 * @param {{texels: number, bytes: number}} room texels of a texture, and bytes of all, at most
 */
async function load(source, room) {
  const [stream, size] = await opened(source);
  const reader = stream.getReader();
  let head = new Uint8Array(0), header = /** @type {Header | null} */ (null);
  while (!header) {
    const { value, done } = await reader.read();
    if (done) throw new SceneError(words.scene.cut);
    head = joined(head, value);
    header = readHeader(head);
    if (!header && head.length > LONGEST_HEADER) throw new SceneError(words.scene.notPly);
  }
  degree = keptDegree(header, room);
  centres = new Float32Array(header.count * 3);
  reach = new Float32Array(header.count);
  port.postMessage({ kind: "header", header: { count: header.count, degree: header.degree, size }, degree });
  await readRows(reader, header, head.subarray(header.begin));
  port.postMessage({ kind: "done", middle: middle() });
}

/**
 * @param {File | string} source
 * @returns {Promise<[ReadableStream<Uint8Array>, number]>}
 */
async function opened(source) {
  if (source instanceof Blob) return [source.stream(), source.size];
  const answer = await fetch(source, { credentials: "same-origin" });
  if (!answer.ok || !answer.body) throw new SceneError(words.scene.notThere);
  return [answer.body, Number(answer.headers.get("content-length") ?? 0)];
}

/**
 * The degree of which all fits.
 *
 * @param {Header} header
 * @param {{texels: number, bytes: number}} room
 */
function keptDegree(header, { texels, bytes }) {
  const fits = (/** @type {number} */ d) => {
    const each = Math.ceil((((d + 1) ** 2 - 1) * 3) / 8);
    return header.count * Math.max(each, 2) <= texels && header.count * (48 + 16 * each) <= bytes;
  };
  let kept = header.degree;
  while (kept > 0 && !fits(kept)) kept--;
  if (header.count * 2 > texels) throw new SceneError(words.scene.tooMany(header.count));
  return kept;
}

/**
 * @param {ReadableStreamDefaultReader<Uint8Array>} reader
 * @param {Header} header
 * @param {Uint8Array} rest behind the header
 */
async function readRows(reader, header, rest) {
  const rows = new Rows(header);
  let batch = batchOf(header, 0), filled = 0, chunk = rest;
  for (;;) {
    while (chunk.length && count < header.count) {
      const taken = Math.min(chunk.length, batch.length - filled);
      batch.set(chunk.subarray(0, taken), filled);
      chunk = chunk.subarray(taken);
      filled += taken;
      if (filled < batch.length) break;
      give(rows, batch, header);
      batch = batchOf(header, count);
      filled = 0;
    }
    if (count >= header.count) break;
    const { value, done } = await reader.read();
    if (done) throw new SceneError(words.scene.cut);
    chunk = value;
  }
  reader.cancel().catch(() => {});
}

/**
 * @param {Header} header
 * @param {number} begin
 */
const batchOf = (header, begin) => new Uint8Array(Math.min(BATCH, header.count - begin) * header.stride);

/**
 * @param {Rows} rows
 * @param {Uint8Array} bytes
 * @param {Header} header
 */
function give(rows, bytes, header) {
  const packed = pack(rows.values(bytes), rows.width, rows.at, header.degree, degree);
  centres.set(packed.centres, count * 3);
  reach.set(packed.reach, count);
  const begin = count;
  count += packed.reach.length;
  const { geometry, colours, harmonics } = packed;
  const first = begin === 0 ? middle() : undefined;
  port.postMessage({ kind: "batch", begin, count: count - begin, geometry, colours, harmonics, middle: first },
    [geometry.buffer, colours.buffer, harmonics.buffer]);
}

/**
 * Middle and radius of where most Gaussians are: strays and background do not count.
 *
 * @returns {{centre: number[], radius: number, low: number[], high: number[]}}
 */
function middle() {
  const step = Math.max(1, Math.floor(count / 20000));
  /** @type {number[]} */
  const picked = [];
  for (let i = 0; i < count; i += step) if (reach[i] > 0) picked.push(i);
  const along = [0, 1, 2].map((axis) => Float64Array.from(picked, (i) => centres[3 * i + axis]).sort());
  const quantile = (/** @type {ArrayLike<number>} */ values, /** @type {number} */ share) => values[Math.floor(share * (values.length - 1))] ?? 0;
  const centre = along.map((values) => quantile(values, 0.5));
  const away = Float64Array.from(picked, (i) => Math.hypot(...centre.map((c, axis) => centres[3 * i + axis] - c))).sort();
  return {
    centre, radius: Math.max(quantile(away, 0.9), 1e-6),
    low: along.map((values) => quantile(values, 0.05)), high: along.map((values) => quantile(values, 0.95)),
  };
}

/**
 * @param {Uint8Array} a
 * @param {Uint8Array} b
 */
function joined(a, b) {
  const both = new Uint8Array(a.length + b.length);
  both.set(a);
  both.set(b, a.length);
  return both;
}
