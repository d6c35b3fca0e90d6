// @ts-check
/** Reader of .splat files. Their layout is that of github.com/antimatter15/splat. */
import { COLOR, LOGITS, OPACITY, ROTATION, SCALES, SH_C0, unpacked } from "./packed.js";

/** @typedef {import("./byte_reader.js").ByteReader} ByteReader */
/** @typedef {import("./scene_file.js").SceneFile} SceneFile */

/** Bytes of a Gaussian: position and scale (float32), color and opacity, rotation (bytes). */
const RECORD = 32;

/**
 * Return whether bytes look like records of a .splat file, which has no header: nearly all have a finite position, a
 * plausible scale and a rotation.
 *
 * @param {Uint8Array} start
 * @param {number} size size of the file in bytes
 */
export function isSplat(start, size) {
  const count = Math.floor(start.length / RECORD), view = new DataView(start.buffer, start.byteOffset, start.length);
  let fit = 0;
  for (let o = 0; o < count * RECORD; o += RECORD) {
    const values = [0, 4, 8, 12, 16, 20].map((part) => view.getFloat32(o + part, true));
    const length = Math.hypot(...[28, 29, 30, 31].map((part) => (start[o + part] - 128) / 128));
    if (values.every(Number.isFinite) && values.slice(3).every((scale) => scale >= 0 && scale < 1e9) && Math.abs(length - 1) < 0.05) fit++;
  }
  return size % RECORD === 0 && fit > 0.9 * count;
}

/** @param {ByteReader} reader @param {number} size size of the file in bytes @returns {SceneFile} */
export function splat(reader, size) {
  return unpacked(size / RECORD, 0, async (_begin, into, width, count) => {
    const bytes = await reader.take(count * RECORD), values = new Float32Array(bytes.buffer);
    for (let i = 0, o = 0, r = 0; i < count; i++, o += width, r += RECORD) {
      for (let axis = 0; axis < 3; axis++) {
        into[o + axis] = values[r / 4 + axis];
        into[o + SCALES + axis] = Math.log(values[r / 4 + 3 + axis]);
        into[o + COLOR + axis] = (bytes[r + 24 + axis] / 255 - 0.5) / SH_C0;
      }
      into[o + OPACITY] = LOGITS[bytes[r + 27]];
      for (let part = 0; part < 4; part++) into[o + ROTATION + part] = (bytes[r + 28 + part] - 128) / 128;
    }
  });
}
