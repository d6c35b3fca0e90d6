// @ts-check
/** Rows of PLY values, which the readers of compressed scenes decode into. */
import { BATCH } from "./packing.js";
import { CLASSIC } from "./render_tag.js";

/** @typedef {import("./scene_file.js").SceneFile} SceneFile */

export const SH_C0 = 0.28209479177387814;
const NAMES = ["x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "f_dc_0", "f_dc_1", "f_dc_2"];
export const OPACITY = 3, SCALES = 4, ROTATION = 7, COLOR = 11, HARMONICS = NAMES.length;
/**
 * Logits of opacities in steps of 1/255. Opacities of exactly 0 and 1 have no finite logit; they are read as 0.25/255
 * and 1 - 0.25/255.
 */
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
 * @returns {SceneFile}
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
