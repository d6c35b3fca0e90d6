// @ts-check
/**
 * Conversion of Gaussians to the layout of the textures.
 *
 * Geometry has 2 texels of 4 uint32. The first has x, y, z as float32, then opacity (low half, in units of 1/65535) and
 * the first scale. The second has the quaternion as four signed 16-bit fractions, the other two scales, and an unused
 * value. Scales are natural logarithms from -20 in steps of 32 / 65535 (a precision of 0.025 %). Colors are three
 * halves. Harmonics are 8 halves per texel, coefficient by coefficient.
 */
import { halfOf } from "./byte_reader.js";
import { CLASSIC } from "./render_tag.js";

/** Number of Gaussians in a batch: fills whole rows of every texture. */
export const BATCH = 1 << 16;
export const SCALE_LOW = -20, SCALE_RANGE = 32;

/**
 * @typedef {{geometry: Uint32Array, colors: Uint16Array, harmonics: Uint16Array, centers: Float32Array,
 *   reach: Float32Array}} Packed `centers` [n * 3]; `reach` [n]: three of the longest standard deviations, world units
 */

/** @param {number} degree of spherical harmonics */
export const harmonicTexels = (degree) => Math.ceil((((degree + 1) ** 2 - 1) * 3) / 8);

/**
 * @param {Float32Array} values rows of `width` values
 * @param {number} width
 * @param {Record<string, number>} at index of each value in a row
 * @param {number} stored degree in the file
 * @param {number} degree degree to keep
 * @returns {Packed}
 */
export function pack(values, width, at, stored, degree) {
  const count = values.length / width, texels = harmonicTexels(degree);
  const packed = {
    geometry: new Uint32Array(count * 8), colors: new Uint16Array(count * 3),
    harmonics: new Uint16Array(count * texels * 8), centers: new Float32Array(count * 3), reach: new Float32Array(count),
  };
  const { geometry, colors, harmonics, centers, reach } = packed, floats = new Float32Array(geometry.buffer);
  const bits = new Uint32Array(values.buffer, values.byteOffset, values.length), all = (stored + 1) ** 2 - 1, kept = (degree + 1) ** 2 - 1;
  const places = Array.from({ length: kept * 3 }, (_, n) => at[`f_rest_${(n % 3) * all + Math.floor(n / 3)}`]), step = 65535 / SCALE_RANGE;
  const { x, y, z, opacity, scale_0, scale_1, scale_2, rot_0, rot_1, rot_2, rot_3, f_dc_0, f_dc_1, f_dc_2 } = at;
  const scale = (/** @type {number} */ value) => Math.min(65535, Math.max(0, Math.round((value - SCALE_LOW) * step)));
  const part = (/** @type {number} */ value) => Math.round(value * 32767) & 0xffff;
  for (let i = 0, o = 0, g = 0; i < count; i++, o += width, g += 8) {
    const a = values[o + rot_0], b = values[o + rot_1], c = values[o + rot_2], d = values[o + rot_3];
    const s0 = values[o + scale_0], s1 = values[o + scale_1], s2 = values[o + scale_2], length = Math.sqrt(a * a + b * b + c * c + d * d);
    const px = values[o + x], py = values[o + y], pz = values[o + z];
    let alpha = 65535 / (1 + Math.exp(-values[o + opacity]));
    const sum = px + py + pz + s0 + s1 + s2 + length;
    if (!(sum - sum === 0) || !(length > 0) || !(alpha >= 0)) alpha = 0; // Gaussians with NaN or infinite values are invisible
    floats[g] = px; floats[g + 1] = py; floats[g + 2] = pz;
    geometry[g + 3] = Math.round(alpha) | (scale(s0) << 16);
    geometry[g + 4] = part(a / length) | (part(b / length) << 16);
    geometry[g + 5] = part(c / length) | (part(d / length) << 16);
    geometry[g + 6] = scale(s1) | (scale(s2) << 16);
    centers[3 * i] = px; centers[3 * i + 1] = py; centers[3 * i + 2] = pz;
    reach[i] = alpha < 257 ? -1 : 3.4 * Math.exp(Math.max(s0, s1, s2)); // below 1/255 nothing is drawn; sqrt(2 ln 255) = 3.33
    colors[3 * i] = halfOf(bits[o + f_dc_0]);
    colors[3 * i + 1] = halfOf(bits[o + f_dc_1]);
    colors[3 * i + 2] = halfOf(bits[o + f_dc_2]);
    for (let n = 0; n < places.length; n++) harmonics[i * texels * 8 + n] = halfOf(bits[o + places[n]]);
  }
  return packed;
}

export const SH_C0 = 0.28209479177387814;
/** Values of a row that every scene has. */
export const NAMES = ["x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "f_dc_0", "f_dc_1", "f_dc_2"];
export const OPACITY = 3, SCALES = 4, ROTATION = 7, COLOR = 11, HARMONICS = NAMES.length;
/** Logits of opacities in steps of 1/255; 0 and 1, which have none, are read as 0.25/255 and 1 - 0.25/255. */
export const LOGITS = Float32Array.from({ length: 256 }, (_, i) => {
  const share = Math.min(Math.max(i / 255, 0.25 / 255), 1 - 0.25 / 255);
  return Math.log(share / (1 - share));
});
const OTHERS = [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]];

/**
 * Return a scene whose rows are decoded by a function.
 *
 * @param {number} count
 * @param {number} degree
 * @param {(begin: number, rows: Float32Array, width: number, count: number) => void | Promise<void>} unpack fills `count` rows
 * @param {import("./render_tag.js").Rendering} rendering
 * @returns {import("./scene_file.js").SceneFile}
 */
export function unpacked(count, degree, unpack, rendering = CLASSIC) {
  const rest = ((degree + 1) ** 2 - 1) * 3, width = HARMONICS + rest;
  const at = Object.fromEntries([...NAMES, ...Array.from({ length: rest }, (_, i) => `f_rest_${i}`)].map((name, place) => [name, place]));
  async function* batches() {
    for (let begin = 0; begin < count; begin += BATCH) {
      const some = Math.min(BATCH, count - begin), rows = new Float32Array(some * width);
      await unpack(begin, rows, width, some);
      yield rows;
    }
  }
  return { count, degree, width, at, rendering, batches };
}

/**
 * Write a unit quaternion that is stored without its largest component.
 *
 * @param {Float32Array} row
 * @param {number} o offset of the quaternion
 * @param {number} largest index of the largest component
 * @param {number[]} three the other components
 * @param {number} [turn] cyclic shift of the components
 */
export function setRotation(row, o, largest, three, turn = 0) {
  const [a, b, c] = three;
  OTHERS[largest].forEach((part, i) => { row[o + ((part + turn) & 3)] = three[i]; });
  row[o + ((largest + turn) & 3)] = Math.sqrt(Math.max(0, 1 - a * a - b * b - c * c));
}
