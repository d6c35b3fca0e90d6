// @ts-check
/** Readers of PLY headers, and of Gaussians as the reference code of 3D Gaussian Splatting writes them. */
import { SceneError } from "./byte_reader.js";
import { BATCH } from "./packing.js";
import { words } from "../words.js";

/** @typedef {import("./byte_reader.js").ByteReader} ByteReader */
/** @typedef {import("./scene_file.js").SceneFile} SceneFile */
/**
 * @typedef {{offset: number, type: string}} Column `offset`: bytes from the start of a row
 * @typedef {{name: string, count: number, stride: number, columns: Record<string, Column>}} Element `stride`: bytes of a row
 * @typedef {{begin: number, elements: Element[]}} Header `begin`: bytes of the header
 */

const SIZES = /** @type {Record<string, number>} */ ({
  char: 1, uchar: 1, int8: 1, uint8: 1, short: 2, ushort: 2, int16: 2, uint16: 2,
  int: 4, uint: 4, int32: 4, uint32: 4, float: 4, float32: 4, double: 8, float64: 8,
});
const NEEDED = ["x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "f_dc_0", "f_dc_1", "f_dc_2"];
/** SH degree by the number of coefficients above degree 0. */
export const DEGREES = /** @type {Record<number, number>} */ ({ 0: 0, 9: 1, 24: 2, 45: 3 });
/** Maximum bytes of a header. */
const LONGEST_HEADER = 1 << 16;

/**
 * @param {ByteReader} reader reader at the start of a PLY; after the call, behind its header
 * @returns {Promise<Header>}
 */
export async function readHeader(reader) {
  for (let size = 4096; ; size *= 2) {
    const text = new TextDecoder("latin1").decode(await reader.peek(size));
    const end = /end_header\r?\n/.exec(text);
    if (end) {
      const begin = end.index + end[0].length;
      await reader.take(begin);
      return { begin, elements: elementsOf(text.slice(0, end.index).split(/\r?\n/)) };
    }
    if (text.length < size) throw new SceneError(words.scene.cut);
    if (size >= LONGEST_HEADER) throw new SceneError(words.scene.notPly);
  }
}

/**
 * @param {string[]} lines
 * @returns {Element[]}
 */
function elementsOf(lines) {
  if (!lines.includes("format binary_little_endian 1.0")) throw new SceneError(words.scene.notBinary);
  /** @type {Element[]} */
  const elements = [];
  for (const line of lines) {
    const [keyword, kind, name] = line.trim().split(/\s+/), element = elements[elements.length - 1];
    if (keyword === "element") elements.push({ name: kind, count: Number(name), stride: 0, columns: {} });
    else if (keyword === "property" && element) {
      element.columns[name] = { offset: element.stride, type: kind };
      element.stride += SIZES[kind] ?? NaN; // a list, whose rows have no fixed size
    }
  }
  return elements;
}

/**
 * @param {ByteReader} reader reader behind the header
 * @param {Header} header
 * @returns {SceneFile}
 */
export function plainPly(reader, { elements }) {
  const [vertex] = elements, names = Object.keys(vertex?.columns ?? {}), rest = names.filter((name) => name.startsWith("f_rest_")).length;
  const wrong = vertex?.name !== "vertex" || !(vertex.count > 0) || !(vertex.stride > 0) || NEEDED.some((name) => !vertex.columns[name]);
  if (wrong || !(rest in DEGREES)) {
    const variant = vertex?.columns.opacity && vertex.columns.rot_0; // such as colors of 8 bits, or SH degree 4
    throw new SceneError(variant ? words.scene.notShown("This kind of PLY") : words.scene.notGaussians);
  }
  return {
    count: vertex.count, degree: DEGREES[rest], width: names.length,
    at: Object.fromEntries(names.map((name, place) => [name, place])),
    async *batches() {
      for (let begin = 0; begin < vertex.count; begin += BATCH) {
        yield floats(vertex, await reader.take(Math.min(BATCH, vertex.count - begin) * vertex.stride));
      }
    },
  };
}

/**
 * Return rows as float32, converted from the types in which they are stored.
 *
 * @param {Element} element
 * @param {Uint8Array} bytes whole rows, at the start of their buffer
 */
export function floats({ stride, columns }, bytes) {
  const all = Object.values(columns);
  if (all.every(({ type }) => type === "float" || type === "float32")) return new Float32Array(bytes.buffer, 0, bytes.length / 4);
  const view = new DataView(bytes.buffer), count = bytes.length / stride, found = new Float32Array(count * all.length);
  all.forEach(({ offset, type }, place) => {
    for (let row = 0; row < count; row++) found[row * all.length + place] = stored(view, row * stride + offset, type);
  });
  return found;
}

/**
 * @param {DataView} view
 * @param {number} at
 * @param {string} type
 */
function stored(view, at, type) {
  if (type.startsWith("float")) return view.getFloat32(at, true);
  if (type === "double" || type === "float64") return view.getFloat64(at, true);
  if (SIZES[type] === 1) return type.startsWith("u") ? view.getUint8(at) : view.getInt8(at);
  if (SIZES[type] === 2) return type.startsWith("u") ? view.getUint16(at, true) : view.getInt16(at, true);
  return type.startsWith("u") ? view.getUint32(at, true) : view.getInt32(at, true);
}
