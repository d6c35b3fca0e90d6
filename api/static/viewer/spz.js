// @ts-check
/** Reader of Niantic's SPZ (versions 1 to 4). Its layout is that of github.com/nianticlabs/spz. */
import { fromHalf, SceneError } from "./byte_reader.js";
import { COLOR, HARMONICS, LOGITS, OPACITY, ROTATION, SCALES, setRotation, unpacked } from "./packing.js";
import { ANTIALIASED, CLASSIC } from "./render_tag.js";
import { decompress } from "../vendor/fzstd/fzstd.js";
import { words } from "../words.js";

/** @typedef {import("./byte_reader.js").ByteReader} ByteReader */
/** @typedef {import("./scene_file.js").SceneFile} SceneFile */

/** Type of the extension record that states the axes, and maximum bytes of records. */
const AXES_EXTENSION = 0xadbe0003, MAX_EXTENSIONS = 1 << 20;
/** Signs of harmonics of degree 1 to 3 under a half rotation about x, from RUB axes (y up, z backward) to a PLY's. */
const ROTATED = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];

/** Version of files whose attributes are zstd streams of their own. */
const SPZ_4 = 4;

/**
 * @typedef {object} SpzAttributes
 * @property {Uint8Array<ArrayBuffer>[]} sections positions, opacities, colors, scales, rotations and harmonics
 * @property {boolean} rotated whether the axes are RUB
 */

/** Return a scene of version 1 to 3, one stream. @param {ByteReader} reader @returns {Promise<SceneFile>} */
export async function spz(reader) {
  const head = new DataView((await reader.take(16)).buffer);
  return spzScene(head, async (sizes) => {
    /** @type {Uint8Array<ArrayBuffer>[]} */
    const sections = [];
    for (const size of sizes) sections.push(await reader.take(size));
    return { sections, rotated: !(head.getUint8(14) & 2) || statesRub(await reader.peek(MAX_EXTENSIONS)) };
  }, SPZ_4 - 1);
}

/** Return a scene of version 4: header, records, sizes, and a zstd stream of each part. @param {ByteReader} reader */
export async function spz4(reader) {
  const head = new DataView((await reader.take(32)).buffer), table = head.getUint32(16, true);
  return spzScene(head, async (sizes) => {
    const streams = sizes.filter(Boolean);
    if (table < 32 || table > 32 + MAX_EXTENSIONS || head.getUint8(15) !== streams.length) throw new SceneError();
    const rotated = statesRub(await reader.take(table - 32)), list = new DataView((await reader.take(16 * streams.length)).buffer);
    /** @type {Uint8Array<ArrayBuffer>[]} */
    const sections = [];
    for (const [i, size] of streams.entries()) {
      const stream = await reader.take(list.getUint32(16 * i, true)), section = new Uint8Array(size);
      if (list.getUint32(16 * i + 8, true) !== size || decompress(stream, section).length !== size) throw new SceneError();
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
  // Spark sets the flag for all scenes; it writes old versions, without extension records and with 12 fractional bits.
  const flags = head.getUint8(14), antialiased = Boolean(flags & 1) && (version === SPZ_4 || Boolean(flags & 2) || head.getUint8(13) !== 12);
  /** @type {SpzAttributes | null} */
  let read = null;
  return unpacked(count, drawn, async (begin, into, width, some) => {
    read ??= await load([version === 1 ? 6 : 9, 1, 3, 3, version < 3 ? 3 : 4, stored].map((bytes) => bytes * count));
    const { sections: [positions, opacities, colors, scales, rotations, harmonics], rotated } = read;
    for (let i = begin, o = 0; i < begin + some; i++, o += width) {
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
      for (let n = 0; n < rest; n++) into[o + HARMONICS + (n % 3) * coefficients + Math.floor(n / 3)] = (harmonics[i * stored + n] - 128) / 128;
      if (!rotated) continue;
      for (const value of [1, 2, ROTATION + 2, ROTATION + 3]) into[o + value] *= -1;
      for (let n = 0; n < rest; n++) into[o + HARMONICS + n] *= ROTATED[n % coefficients];
    }
  }, antialiased ? ANTIALIASED : CLASSIC);
}

/** Return whether records (type, length, content) state RUB axes, or none. @param {Uint8Array} records */
function statesRub(records) {
  const view = new DataView(records.buffer, records.byteOffset, records.length);
  for (let o = 0; o + 12 <= records.length; o += 8 + view.getUint32(o + 4, true)) {
    if (view.getUint32(o, true) === AXES_EXTENSION) return [0, 4].includes(view.getUint32(o + 8, true));
  }
  return true;
}
