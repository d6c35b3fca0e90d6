// @ts-check
/** Readers of .splat (github.com/antimatter15/splat) and mkkellogg's .ksplat, as `sgsst_core/files/formats/splat.py` describes it. */
import { fromHalf, SceneError } from "./byte_reader.js";
import { COLOR, HARMONICS, LOGITS, OPACITY, ROTATION, SCALES, SH_C0, unpacked } from "./packing.js";

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

const HEADER = 4096, SECTION = 1024, MAX_SECTIONS = 1024;
/** Default of the largest position step and of the range of SH coefficients at level 2. */
const STEPS = 32767, RANGE = 1.5;
/** Log scale of those that 16-bit floats round to 0. */
const MIN_SCALE = -25 * Math.LN2;

/**
 * @typedef {object} Section
 * @property {number} count number of Gaussians
 * @property {number} room number of rows, of which the last ones are unused
 * @property {number} degree
 * @property {number} bucketSize number of Gaussians in a full bucket
 * @property {number} full number of full buckets
 * @property {number} partial number of other buckets
 * @property {number} buckets number of centers
 * @property {number} step position step
 * @property {number} steps steps from the least position in a bucket to its center
 */

/** Return whether bytes look like a header, which has no magic number beyond a version. @param {Uint8Array} start */
export function isKsplat(start) {
  const view = new DataView(start.buffer, start.byteOffset, start.length);
  if (start.length < HEADER || view.getUint32(0) !== 0x00010000) return false;
  const sections = view.getUint32(4, true), finite = [24, 28, 32].every((place) => Number.isFinite(view.getFloat32(place, true)));
  return sections > 0 && view.getUint32(8, true) <= sections && view.getUint32(16, true) > 0 && view.getUint16(20, true) < 3 && finite;
}

/** @param {ByteReader} reader @returns {Promise<SceneFile>} */
export async function ksplat(reader) {
  const head = new DataView((await reader.take(HEADER)).buffer), number = head.getUint32(4, true), count = head.getUint32(16, true);
  const level = head.getUint16(20, true), low = head.getFloat32(36, true) || -RANGE, high = head.getFloat32(40, true) || RANGE;
  if (number > MAX_SECTIONS) throw new SceneError();
  const table = new DataView((await reader.take(number * SECTION)).buffer);
  const sections = Array.from({ length: number }, (_, i) => sectionAt(table, i * SECTION));
  const degree = Math.max(...sections.map((section) => section.degree)), coefficients = (degree + 1) ** 2 - 1;
  if (sections.reduce((sum, section) => sum + section.count, 0) !== count || !(degree < 3)) throw new SceneError();
  /** @type {(row: DataView, place: number) => number} */
  const value = level ? (row, place) => fromHalf(row.getUint16(place, true)) : (row, place) => row.getFloat32(place, true);
  const harmonic = level < 2 ? value : (/** @type {DataView} */ row, /** @type {number} */ place) => low + (high - low) * (row.getUint8(place) / 255);
  const width = level ? 2 : 4, harmonicWidth = [4, 2, 1][level];
  let current = -1, begun = 0, bucket = 0, bucketEnd = 0;
  let lengths = new Uint32Array(0), centers = new Float32Array(0);

  /** Begin the next section that has Gaussians. */
  async function next() {
    for (;;) {
      const last = sections[current], section = sections[++current];
      if (last) await reader.take((last.room - last.count) * rowBytes(last.degree));
      lengths = new Uint32Array((await reader.take(4 * section.partial)).buffer);
      centers = new Float32Array((await reader.take(level ? 12 * section.buckets : 0)).buffer);
      [begun, bucket, bucketEnd] = [0, -1, 0];
      if (section.count) return;
    }
  }
  const rowBytes = (/** @type {number} */ of) => 10 * width + 4 + 3 * ((of + 1) ** 2 - 1) * harmonicWidth;

  return unpacked(count, degree, async (_begin, into, rowWidth, some) => {
    for (let filled = 0; filled < some;) {
      if (current < 0 || begun === sections[current].count) await next();
      const section = sections[current], part = Math.min(some - filled, section.count - begun), bytes = rowBytes(section.degree);
      const rows = new DataView((await reader.take(part * bytes)).buffer);
      for (let i = 0, r = 0, o = filled * rowWidth; i < part; i++, r += bytes, o += rowWidth) {
        if (level) {
          while (begun + i >= bucketEnd) {
            bucket++;
            if (bucket >= section.full + section.partial) throw new SceneError();
            bucketEnd += bucket < section.full ? section.bucketSize : lengths[bucket - section.full];
          }
        }
        for (let axis = 0; axis < 3; axis++) {
          into[o + axis] = level
            ? (rows.getUint16(r + 2 * axis, true) - section.steps) * section.step + centers[3 * bucket + axis]
            : rows.getFloat32(r + 4 * axis, true);
          const scale = Math.log(value(rows, r + (3 + axis) * width));
          into[o + SCALES + axis] = level ? Math.max(scale, MIN_SCALE) : scale;
          into[o + COLOR + axis] = (rows.getUint8(r + 10 * width + axis) / 255 - 0.5) / SH_C0;
        }
        for (let q = 0; q < 4; q++) into[o + ROTATION + q] = value(rows, r + (6 + q) * width);
        into[o + OPACITY] = LOGITS[rows.getUint8(r + 10 * width + 3)];
        for (let band = 1, first = 0; band <= section.degree; first += 2 * band + 1, band++) { // channel-major in each band
          for (let c = 0; c < 3; c++) {
            for (let n = 0; n < 2 * band + 1; n++) {
              const place = r + 10 * width + 4 + (3 * first + c * (2 * band + 1) + n) * harmonicWidth;
              into[o + HARMONICS + c * coefficients + first + n] = harmonic(rows, place);
            }
          }
        }
      }
      begun += part;
      filled += part;
    }
  });
}

/** @param {DataView} table @param {number} o offset of the section's entry @returns {Section} */
function sectionAt(table, o) {
  const integer = (/** @type {number} */ place) => table.getUint32(o + place, true);
  const steps = integer(24) || STEPS, count = integer(0), room = integer(4);
  if (count > room) throw new SceneError();
  return {
    count, room, degree: table.getUint16(o + 40, true), bucketSize: integer(8), buckets: integer(12), full: integer(32),
    partial: integer(36), step: table.getFloat32(o + 16, true) / 2 / steps, steps,
  };
}
