// @ts-check
/** The header of a PLY as the code of 3D Gaussian Splatting writes it. */
import { words } from "../words.js";

/**
 * @typedef {{offset: number, type: string}} Column where a value stands in a row, bytes
 * @typedef {{count: number, degree: number, stride: number, begin: number, columns: Record<string, Column>,
 *   floats: boolean}} Header
 *   `begin`: bytes of the header; `floats`: every value is a float32
 */

/** A file that cannot be shown; the message is for people. */
export class SceneError extends Error {}

const SIZES = /** @type {Record<string, number>} */ ({
  char: 1, uchar: 1, int8: 1, uint8: 1, short: 2, ushort: 2, int16: 2, uint16: 2,
  int: 4, uint: 4, int32: 4, uint32: 4, float: 4, float32: 4, double: 8, float64: 8,
});
const NEEDED = ["x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "f_dc_0", "f_dc_1", "f_dc_2"];
const DEGREES = /** @type {Record<number, number>} */ ({ 0: 0, 9: 1, 24: 2, 45: 3 });
/** No header is longer. */
export const LONGEST_HEADER = 1 << 16;

/**
 * @param {Uint8Array} bytes the beginning of a file
 * @returns {Header | null} null where the header goes on behind them
 */
export function readHeader(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, LONGEST_HEADER));
  if (!text.startsWith("ply".slice(0, text.length))) throw new SceneError(words.scene.notPly);
  const end = /end_header\r?\n/.exec(text);
  if (!end) {
    if (text.length >= LONGEST_HEADER) throw new SceneError(words.scene.notPly);
    return null;
  }
  return parseHeader(text.slice(0, end.index).split(/\r?\n/), end.index + end[0].length);
}

/**
 * @param {string[]} lines
 * @param {number} begin
 * @returns {Header}
 */
function parseHeader(lines, begin) {
  if (!lines.includes("format binary_little_endian 1.0")) throw new SceneError(words.scene.notBinary);
  const columns = /** @type {Record<string, Column>} */ ({});
  let count = -1, stride = 0, rest = 0, floats = true, element = "";
  for (const line of lines) {
    const [keyword, kind, name] = line.trim().split(/\s+/);
    if (keyword === "element") {
      if (kind === "vertex") count = Number(name);
      else if (count < 0) throw new SceneError(words.scene.notGaussians);
      element = kind;
    } else if (keyword === "property" && element === "vertex") {
      if (!SIZES[kind]) throw new SceneError(words.scene.notGaussians);
      columns[name] = { offset: stride, type: kind };
      stride += SIZES[kind];
      floats &&= kind === "float" || kind === "float32";
      if (name.startsWith("f_rest_")) rest++;
    }
  }
  if (columns.packed_position) throw new SceneError(words.scene.packed);
  if (!(count > 0) || NEEDED.some((name) => !columns[name]) || !(rest in DEGREES)) throw new SceneError(words.scene.notGaussians);
  return { count, degree: DEGREES[rest], stride, begin, columns, floats };
}

/** Float32 values of rows, whatever types they are stored as. */
export class Rows {
  /** @param {Header} header */
  constructor(header) {
    this.header = header;
    this.names = Object.keys(header.columns);
    /** Values of a row. */
    this.width = this.names.length;
    this.at = Object.fromEntries(this.names.map((name, place) => [name, place]));
  }

  /**
   * @param {Uint8Array} bytes whole rows, beginning at a multiple of 4 of their buffer
   * @returns {Float32Array}
   */
  values(bytes) {
    if (this.header.floats) return new Float32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4);
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), { stride, columns } = this.header;
    const count = bytes.byteLength / stride, found = new Float32Array(count * this.width);
    this.names.forEach((name, place) => {
      const { offset, type } = columns[name];
      for (let row = 0; row < count; row++) found[row * this.width + place] = stored(view, row * stride + offset, type);
    });
    return found;
  }
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
