// @ts-check
/**
 * Readers of compressed scenes: PlayCanvas' compressed PLY, Niantic's SPZ (versions 1 to 4) and antimatter15's .splat.
 *
 * Layouts are those of github.com/playcanvas/splat-transform, github.com/nianticlabs/spz and
 * github.com/antimatter15/splat. All are converted to rows of PLY values.
 */
import { SceneError } from "./byte_reader.js";
import { BATCH } from "./packing.js";
import { DEGREES, floats } from "./ply.js";
import { ANTIALIASED, CLASSIC, plyRendering } from "./render_tag.js";
import { decompress } from "../vendor/fzstd/fzstd.js";
import { words } from "../words.js";

/** @typedef {import("./byte_reader.js").ByteReader} ByteReader */
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

// --- compressed PLY --------------------------------------------------------------------------------------------------

/** Number of Gaussians that share their bounds. */
const CHUNK = 256;
const BOUNDS = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
/** Values of the bytes of spherical harmonics. */
const STEPS = Float32Array.from({ length: 256 }, (_, i) => (i === 0 ? -4 : i === 255 ? 4 : (i + 0.5) / 32 - 4));

/**
 * @param {ByteReader} reader reader behind the header
 * @param {import("./ply.js").Header} header
 * @returns {SceneFile}
 */
export function compressedPly(reader, { elements, comments }) {
  const [chunk, vertex, sh] = elements, rest = sh ? Object.keys(sh.columns).length : 0;
  const wrong = chunk.name !== "chunk" || vertex?.name !== "vertex" || !(vertex.count > 0) || vertex.stride !== 16
    || chunk.count !== Math.ceil(vertex.count / CHUNK) || !(chunk.stride > 0) || !("packed_position" in vertex.columns)
    || (sh && (sh.name !== "sh" || sh.count !== vertex.count || sh.stride !== rest)) || !(rest in DEGREES);
  if (wrong) throw new SceneError(words.scene.notGaussians);
  /** @type {{bounds: Float32Array, rows: Uint32Array} | null} */
  let read = null;
  return unpacked(vertex.count, DEGREES[rest], async (begin, into, width, count) => {
    read ??= await chunksAndRows(reader, chunk, vertex);
    const order = ["packed_position", "packed_rotation", "packed_scale", "packed_color"].map((name) => vertex.columns[name].offset / 4);
    for (let i = 0; i < count; i++) unpackRow(read, begin + i, order, into, i * width);
    if (!rest) return;
    const bytes = await reader.take(count * rest);
    for (let i = 0; i < count; i++) for (let n = 0; n < rest; n++) into[i * width + HARMONICS + n] = STEPS[bytes[i * rest + n]];
  }, plyRendering(comments, []));
}

/**
 * Read the bounds of all chunks and all rows. The bounds are the low and high of each of 9 values; colors are in 0..1
 * if the file has no bounds for them.
 *
 * @param {ByteReader} reader
 * @param {import("./ply.js").Element} chunk
 * @param {import("./ply.js").Element} vertex
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

/**
 * @param {{bounds: Float32Array, rows: Uint32Array}} read
 * @param {number} i index of the Gaussian
 * @param {number[]} order order of the four packed values
 * @param {Float32Array} into
 * @param {number} o offset of its row
 */
function unpackRow({ bounds, rows }, i, order, into, o) {
  const [position, rotation, scale, color] = order.map((place) => rows[4 * i + place]), b = 18 * Math.floor(i / CHUNK);
  const between = (/** @type {number} */ part, /** @type {number} */ share) => bounds[b + 2 * part] * (1 - share) + bounds[b + 2 * part + 1] * share;
  [[position, 0, 0], [scale, 3, SCALES]].forEach(([packed, part, place]) => {
    into[o + place] = between(part, (packed >>> 21) / 2047);
    into[o + place + 1] = between(part + 1, ((packed >>> 11) & 1023) / 1023);
    into[o + place + 2] = between(part + 2, (packed & 2047) / 2047);
  });
  for (let c = 0; c < 3; c++) into[o + COLOR + c] = (between(6 + c, ((color >>> (24 - 8 * c)) & 255) / 255) - 0.5) / SH_C0;
  into[o + OPACITY] = LOGITS[color & 255];
  setRotation(into, o + ROTATION, rotation >>> 30, [20, 10, 0].map((shift) => (((rotation >>> shift) & 1023) / 1023 - 0.5) * Math.SQRT2));
}

// --- SPZ -------------------------------------------------------------------------------------------------------------

/** Type of the extension record that states the axes, and maximum bytes of records. */
const AXES_EXTENSION = 0xadbe0003, MAX_EXTENSIONS = 1 << 20;
/**
 * Signs of the harmonics' coefficients of degree 1 to 3 under a half rotation about x, from axes with y up and z
 * backward (RUB) to those of a PLY.
 */
const ROTATED = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];

/** Version of files whose attributes are zstd streams of their own. */
const SPZ_4 = 4;

/**
 * @typedef {object} SpzAttributes
 * @property {Uint8Array<ArrayBuffer>[]} sections positions, opacities, colors, scales, rotations and harmonics
 * @property {boolean} rotated whether the axes are RUB
 */

/**
 * Return a scene of SPZ version 1 to 3, which is one stream.
 *
 * @param {ByteReader} reader reader of the stream, which files compress
 * @returns {Promise<SceneFile>}
 */
export async function spz(reader) {
  const head = new DataView((await reader.take(16)).buffer);
  return spzScene(head, async (sizes) => {
    /** @type {Uint8Array<ArrayBuffer>[]} */
    const sections = [];
    for (const size of sizes) sections.push(await reader.take(size));
    return { sections, rotated: Boolean(head.getUint8(14) & 2) && statesRub(await reader.peek(MAX_EXTENSIONS)) };
  }, SPZ_4 - 1);
}

/**
 * Return a scene of SPZ version 4: header, extension records, sizes of the streams, and a zstd stream for each section
 * that is not empty.
 *
 * @param {ByteReader} reader
 * @returns {Promise<SceneFile>}
 */
export async function spz4(reader) {
  const head = new DataView((await reader.take(32)).buffer), table = head.getUint32(16, true);
  return spzScene(head, async (sizes) => {
    const streams = sizes.filter(Boolean);
    if (table < 32 || table > 32 + MAX_EXTENSIONS || head.getUint8(15) !== streams.length) throw new SceneError(words.scene.unreadable);
    const rotated = statesRub(await reader.take(table - 32)), list = new DataView((await reader.take(16 * streams.length)).buffer);
    /** @type {Uint8Array<ArrayBuffer>[]} */
    const sections = [];
    for (const [i, size] of streams.entries()) {
      const stream = await reader.take(list.getUint32(16 * i, true)), section = new Uint8Array(size);
      if (list.getUint32(16 * i + 8, true) !== size || decompress(stream, section).length !== size) throw new SceneError(words.scene.unreadable);
      sections.push(section);
    }
    return { sections: [...sections, new Uint8Array(0)], rotated };
  }, SPZ_4);
}

/**
 * @param {DataView} head first fields, which all versions share
 * @param {(sizes: number[]) => Promise<SpzAttributes>} load reads sections of these sizes in bytes
 * @param {number} newest newest version that can be read
 * @returns {SceneFile}
 */
function spzScene(head, load, newest) {
  const version = head.getUint32(4, true), count = head.getUint32(8, true), degree = head.getUint8(12), unit = 2 ** -head.getUint8(13);
  if (head.getUint32(0, true) !== 0x5053474e) throw new SceneError(words.scene.notScene);
  if (version < 1 || version > newest) throw new SceneError(words.scene.newSpz);
  if (!count || degree > 4) throw new SceneError(words.scene.notGaussians);
  // degree 4 is skipped
  const drawn = Math.min(degree, 3), stored = ((degree + 1) ** 2 - 1) * 3, rest = ((drawn + 1) ** 2 - 1) * 3, coefficients = rest / 3;
  // Spark sets the flag for all scenes; it writes old versions, without extension records.
  const flags = head.getUint8(14), antialiased = Boolean(flags & 1) && (version === SPZ_4 || Boolean(flags & 2));
  /** @type {SpzAttributes | null} */
  let read = null;
  return unpacked(count, drawn, async (begin, into, width, some) => {
    read ??= await load([version === 1 ? 6 : 9, 1, 3, 3, version < 3 ? 3 : 4, stored].map((bytes) => bytes * count));
    const { sections, rotated } = read, harmonics = sections[5];
    for (let i = 0; i < some; i++) {
      unpackSpz(sections, begin + i, version, unit, into, i * width);
      for (let n = 0; n < rest; n++) {
        into[i * width + HARMONICS + (n % 3) * coefficients + Math.floor(n / 3)] = (harmonics[(begin + i) * stored + n] - 128) / 128;
      }
      if (rotated) rotate(into, i * width, coefficients);
    }
  }, antialiased ? ANTIALIASED : CLASSIC);
}

/**
 * Return whether extension records state that the axes are RUB. A record has a type, a length in bytes, and content.
 *
 * @param {Uint8Array} records
 */
function statesRub(records) {
  const view = new DataView(records.buffer, records.byteOffset, records.length);
  for (let o = 0; o + 12 <= records.length; o += 8 + view.getUint32(o + 4, true)) {
    if (view.getUint32(o, true) === AXES_EXTENSION) return [0, 4].includes(view.getUint32(o + 8, true));
  }
  return false;
}

/**
 * Rotate a Gaussian by 180 degrees about x.
 *
 * @param {Float32Array} into
 * @param {number} o offset of its row
 * @param {number} coefficients number of harmonics per color channel
 */
function rotate(into, o, coefficients) {
  for (const value of [1, 2, ROTATION + 2, ROTATION + 3]) into[o + value] *= -1;
  for (let n = 0; n < 3 * coefficients; n++) into[o + HARMONICS + n] *= ROTATED[n % coefficients];
}

/**
 * @param {Uint8Array<ArrayBuffer>[]} sections positions, opacities, colors, scales, rotations
 * @param {number} i index of the Gaussian
 * @param {number} version
 * @param {number} unit unit of positions
 * @param {Float32Array} into
 * @param {number} o offset of its row
 */
function unpackSpz([positions, opacities, colors, scales, rotations], i, version, unit, into, o) {
  for (let axis = 0; axis < 3; axis++) {
    const p = 9 * i + 3 * axis;
    into[o + axis] = version === 1
      ? fromHalf(positions[6 * i + 2 * axis] | (positions[6 * i + 2 * axis + 1] << 8))
      : (((positions[p] | (positions[p + 1] << 8) | (positions[p + 2] << 16)) << 8) >> 8) * unit;
    into[o + SCALES + axis] = scales[3 * i + axis] / 16 - 10;
    into[o + COLOR + axis] = (colors[3 * i + axis] / 255 - 0.5) / 0.15;
  }
  into[o + OPACITY] = LOGITS[opacities[i]];
  if (version < 3) setRotation(into, o + ROTATION, 0, [0, 1, 2].map((part) => rotations[3 * i + part] / 127.5 - 1));
  else {
    const r = 4 * i, packed = rotations[r] | (rotations[r + 1] << 8) | (rotations[r + 2] << 16) | (rotations[r + 3] << 24);
    const part = (/** @type {number} */ bits) => ((bits & 512 ? -1 : 1) * (bits & 511) * Math.SQRT1_2) / 511;
    setRotation(into, o + ROTATION, packed >>> 30, [20, 10, 0].map((shift) => part((packed >>> shift) & 1023)), 1);
  }
}

/** @param {number} half bits of a half */
export function fromHalf(half) {
  const sign = half & 0x8000 ? -1 : 1, exponent = (half >> 10) & 31, fraction = half & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
}

// --- .splat ----------------------------------------------------------------------------------------------------------

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

/**
 * @param {ByteReader} reader
 * @param {number} size size of the file in bytes
 * @returns {SceneFile}
 */
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
