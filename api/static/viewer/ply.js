// @ts-check
/** Readers of PLY files: of the reference code of 3D Gaussian Splatting, and PlayCanvas' compressed ones (github.com/playcanvas/splat-transform). */
import { words } from "../words.js";
import { CutError, SceneError } from "./byte_reader.js";
import { BATCH, COLOR, HARMONICS, LOGITS, NAMES, OPACITY, ROTATION, SCALE_LOW, SCALES, setRotation, SH_C0, unpacked } from "./packing.js";
import { isFlat, plyRendering } from "./render_tag.js";

/** @typedef {import("./byte_reader.js").ByteReader} ByteReader */
/** @typedef {import("./scene_file.js").SceneFile} SceneFile */
/**
 * @typedef {{offset: number, type: string}} Column `offset`: bytes from the start of a row
 * @typedef {{name: string, count: number, stride: number, columns: Record<string, Column>, little: boolean}} Element `stride`:
 *   bytes of a row; `little`: whether values are little-endian
 * @typedef {{begin: number, elements: Element[], comments: string[], text: boolean}} Header `begin`: bytes of the header;
 *   `text`: whether values are written as text
 */

/** Readers of types: method of a DataView, and bytes. */
const TYPES = /** @type {Record<string, ["getInt8" | "getUint8" | "getInt16" | "getUint16" | "getInt32" | "getUint32" | "getFloat32" | "getFloat64", number]>} */ ({
  char: ["getInt8", 1], int8: ["getInt8", 1], uchar: ["getUint8", 1], uint8: ["getUint8", 1],
  short: ["getInt16", 2], int16: ["getInt16", 2], ushort: ["getUint16", 2], uint16: ["getUint16", 2],
  int: ["getInt32", 4], int32: ["getInt32", 4], uint: ["getUint32", 4], uint32: ["getUint32", 4],
  float: ["getFloat32", 4], float32: ["getFloat32", 4], double: ["getFloat64", 8], float64: ["getFloat64", 8],
});
/** SH degree by the number of coefficients above degree 0. */
const DEGREES = /** @type {Record<number, number>} */ ({ 0: 0, 9: 1, 24: 2, 45: 3 });
const TEXT = "format ascii 1.0";
/** Maximum bytes of a header, and of a line of text. */
const LONGEST_HEADER = 1 << 16;

/** @param {ByteReader} reader at the start of a PLY; later behind its header @returns {Promise<Header>} */
export async function readHeader(reader) {
  for (let size = 4096; ; size *= 2) {
    const text = new TextDecoder("latin1").decode(await reader.peek(size));
    const end = /end_header\r?\n/.exec(text);
    if (end) {
      const begin = end.index + end[0].length;
      await reader.take(begin);
      const lines = text.slice(0, end.index).split(/\r?\n/);
      const comments = lines.filter((line) => line.startsWith("comment ")).map((line) => line.slice(8).trim());
      return { begin, elements: elementsOf(lines), comments, text: lines.includes(TEXT) };
    }
    if (text.length < size) throw new CutError(words.scene.cut);
    if (size >= LONGEST_HEADER) throw new SceneError(words.scene.notPly);
  }
}

/** @param {Header} header @param {number} size bytes; 0 if unknown @throws {CutError} if the file is shorter */
export function checkLength({ begin, elements, text }, size) {
  if (text) return; // the length of a line is not known
  const declared = elements.reduce((sum, { count, stride }) => sum + count * stride, begin);
  if (size && declared > size) throw new CutError(words.scene.shorter(elements.find(({ name }) => name === "vertex")?.count ?? 0, declared, size));
}

/** @param {string[]} lines @returns {Element[]} */
function elementsOf(lines) {
  const little = !lines.includes("format binary_big_endian 1.0");
  if (little && !lines.includes("format binary_little_endian 1.0") && !lines.includes(TEXT)) throw new SceneError(words.scene.notPly);
  /** @type {Element[]} */
  const elements = [];
  for (const line of lines) {
    const [keyword, kind, name] = line.trim().split(/\s+/), element = elements[elements.length - 1];
    if (keyword === "element") elements.push({ name: kind, count: Number(name), stride: 0, columns: {}, little });
    else if (keyword === "property" && element) {
      element.columns[name] = { offset: element.stride, type: kind };
      element.stride += TYPES[kind]?.[1] ?? NaN; // a list, whose rows have no fixed size
    }
  }
  return elements;
}

/** @param {ByteReader} reader reader behind the header @param {Header} header @returns {SceneFile} */
export function plainPly(reader, { elements, comments, text }) {
  const [vertex] = elements, names = Object.keys(vertex?.columns ?? {}), rest = names.filter((name) => name.startsWith("f_rest_")).length;
  const wrong = vertex?.name !== "vertex" || !(vertex.count > 0) || !(vertex.stride > 0) || NAMES.some((name) => !vertex.columns[name] && !(name === "scale_2" && isFlat(names)));
  if (wrong || !(rest in DEGREES)) {
    const variant = vertex?.columns.opacity && vertex.columns.rot_0; // such as colors of 8 bits, or SH degree 4
    throw new SceneError(variant ? words.scene.notShown("This kind of PLY") : words.scene.notGaussians);
  }
  const flat = isFlat(names), at = Object.fromEntries([...names, ...(flat ? ["scale_2"] : [])].map((name, place) => [name, place]));
  return {
    count: vertex.count, degree: DEGREES[rest], width: names.length + Number(flat), at,
    rendering: plyRendering(comments, names),
    async *batches() {
      const written = text ? textLines(reader) : null;
      for (let begin = 0; begin < vertex.count; begin += BATCH) {
        const count = Math.min(BATCH, vertex.count - begin);
        const rows = written ? await numbers(written, count, names.length) : floats(vertex, await reader.take(count * vertex.stride));
        if (at.filter_3D !== undefined) applyFilter(rows, names.length, at);
        yield flat ? withoutThickness(rows, names.length) : rows;
      }
    },
  };
}

/** Yield the lines of a text that are not empty. @param {ByteReader} reader */
async function* textLines(reader) {
  for (let line = ""; ;) {
    const part = await reader.some();
    const [...whole] = (line + new TextDecoder("latin1").decode(part ?? new Uint8Array(0))).split("\n");
    line = part ? /** @type {string} */ (whole.pop()) : "";
    if (line.length > LONGEST_HEADER) throw new SceneError();
    for (const each of whole) if (each.trim()) yield each.trim();
    if (!part) return;
  }
}

/** Return the next rows. @param {AsyncGenerator<string>} written @param {number} count @param {number} width */
async function numbers(written, count, width) {
  const rows = new Float32Array(count * width);
  for (let row = 0; row < count; row++) {
    const { value } = await written.next();
    if (value === undefined) throw new CutError(words.scene.cut);
    const values = value.split(/\s+/);
    if (values.length !== width) throw new SceneError();
    rows.set(values.map(Number), row * width);
  }
  return rows;
}

/**
 * Convolve Gaussians with the 3D filters of Mip-Splatting, as `sgsst_core/files/scene_file.py` does.
 *
 * @param {Float32Array} rows
 * @param {number} width
 * @param {Record<string, number>} at
 */
function applyFilter(rows, width, at) {
  for (let o = 0; o < rows.length; o += width) {
    const filter = 2 * Math.log(Math.abs(rows[o + at.filter_3D]));
    let ratio = 0;
    for (const place of [at.scale_0, at.scale_1, at.scale_2]) {
      if (place === undefined) continue;
      const before = rows[o + place], larger = Math.max(2 * before, filter), smaller = Math.min(2 * before, filter);
      const after = (larger + Math.log1p(Math.exp(smaller - larger))) / 2;
      rows[o + place] = after;
      ratio += before - after;
    }
    const logit = rows[o + at.opacity], filtered = ratio - Math.log1p(Math.exp(-logit));
    if (ratio < 0) rows[o + at.opacity] = filtered - Math.log(-Math.expm1(filtered));
  }
}

/** Return rows with a last value for the missing scale_2. @param {Float32Array} rows @param {number} width */
function withoutThickness(rows, width) {
  const count = rows.length / width, found = new Float32Array(count * (width + 1)).fill(SCALE_LOW);
  for (let row = 0; row < count; row++) found.set(rows.subarray(row * width, (row + 1) * width), row * (width + 1));
  return found;
}

/** Return rows as float32. @param {Element} element @param {Uint8Array} bytes at the start of their buffer */
function floats({ stride, columns, little }, bytes) {
  const all = Object.values(columns);
  if (little && all.every(({ type }) => type === "float" || type === "float32")) return new Float32Array(bytes.buffer, 0, bytes.length / 4);
  const view = new DataView(bytes.buffer), count = bytes.length / stride, found = new Float32Array(count * all.length);
  all.forEach(({ offset, type }, place) => {
    for (let row = 0; row < count; row++) found[row * all.length + place] = view[TYPES[type][0]](row * stride + offset, little);
  });
  return found;
}

/** Number of Gaussians that share their bounds. */
const CHUNK = 256;
const BOUNDS = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
/** Values of the bytes of spherical harmonics. */
const STEPS = Float32Array.from({ length: 256 }, (_, i) => (i === 0 ? -4 : i === 255 ? 4 : (i + 0.5) / 32 - 4));

/** @param {ByteReader} reader reader behind the header @param {Header} header @returns {SceneFile} */
export function compressedPly(reader, { elements, comments }) {
  const [chunk, vertex, sh] = elements, rest = sh ? Object.keys(sh.columns).length : 0;
  const wrong = chunk.name !== "chunk" || !chunk.little || vertex?.name !== "vertex" || !(vertex.count > 0) || vertex.stride !== 16
    || chunk.count !== Math.ceil(vertex.count / CHUNK) || !(chunk.stride > 0) || !("packed_position" in vertex.columns)
    || (sh && (sh.name !== "sh" || sh.count !== vertex.count || sh.stride !== rest)) || !(rest in DEGREES);
  if (wrong) throw new SceneError(words.scene.notGaussians);
  const order = ["packed_position", "packed_rotation", "packed_scale", "packed_color"].map((name) => vertex.columns[name].offset / 4);
  /** @type {{bounds: Float32Array, rows: Uint32Array} | null} */
  let read = null;
  return unpacked(vertex.count, DEGREES[rest], async (begin, into, width, count) => {
    const { bounds, rows } = (read ??= await chunksAndRows(reader, chunk, vertex)), bytes = await reader.take(count * rest);
    for (let i = 0, o = 0; i < count; i++, o += width) {
      const [position, rotation, scale, color] = order.map((place) => rows[4 * (begin + i) + place]), b = 18 * Math.floor((begin + i) / CHUNK);
      const between = (/** @type {number} */ part, /** @type {number} */ share) => bounds[b + 2 * part] * (1 - share) + bounds[b + 2 * part + 1] * share;
      [[position, 0, 0], [scale, 3, SCALES]].forEach(([packed, part, place]) => {
        into[o + place] = between(part, (packed >>> 21) / 2047);
        into[o + place + 1] = between(part + 1, ((packed >>> 11) & 1023) / 1023);
        into[o + place + 2] = between(part + 2, (packed & 2047) / 2047);
      });
      for (let c = 0; c < 3; c++) into[o + COLOR + c] = (between(6 + c, ((color >>> (24 - 8 * c)) & 255) / 255) - 0.5) / SH_C0;
      into[o + OPACITY] = LOGITS[color & 255];
      setRotation(into, o + ROTATION, rotation >>> 30, [20, 10, 0].map((shift) => (((rotation >>> shift) & 1023) / 1023 - 0.5) * Math.SQRT2));
      for (let n = 0; n < rest; n++) into[o + HARMONICS + n] = STEPS[bytes[i * rest + n]];
    }
  }, plyRendering(comments, []));
}

/**
 * Read the bounds of all chunks and all rows. The bounds are the low and high of each of 9 values; colors are in 0..1
 * if the file has no bounds for them.
 *
 * @param {ByteReader} reader
 * @param {Element} chunk
 * @param {Element} vertex
 */
async function chunksAndRows(reader, chunk, vertex) {
  const values = floats(chunk, await reader.take(chunk.count * chunk.stride)), names = Object.keys(chunk.columns);
  const bounds = new Float32Array(chunk.count * 18).fill(1);
  BOUNDS.forEach((name, part) => ["min", "max"].forEach((side, high) => {
    const place = names.indexOf(`${side}_${name}`);
    if (place < 0 && part < 6) throw new SceneError(words.scene.notGaussians);
    for (let i = 0; i < chunk.count; i++) bounds[18 * i + 2 * part + high] = place < 0 ? high : values[i * names.length + place];
  }));
  return { bounds, rows: new Uint32Array((await reader.take(vertex.count * vertex.stride)).buffer) };
}
