// @ts-check
/** Reader of ZIP archives below 4 GB. */
import { CutError, SceneError } from "./byte_reader.js";
import { words } from "../words.js";

/** @typedef {Map<string, () => Promise<Uint8Array<ArrayBuffer>>>} Files functions that unpack a file, by its name */

const END = 0x06054b50, END_BYTES = 22, MAX_COMMENT = 65535, ENTRY = 0x02014b50, ENTRY_BYTES = 46;
const STORED = 0, DEFLATED = 8;

/**
 * Return the files of an archive.
 *
 * @param {Uint8Array<ArrayBuffer>} data
 * @returns {Promise<Files>}
 * @throws {CutError} if the archive ends too early
 */
export async function unzipped(data) {
  const view = new DataView(data.buffer, data.byteOffset, data.length), { length } = data;
  let end = length - END_BYTES;
  while (end >= 0 && end >= length - END_BYTES - MAX_COMMENT && view.getUint32(end, true) !== END) end--;
  if (end < 0 || view.getUint32(end, true) !== END) throw new CutError(words.scene.cut);
  /** @type {Files} */
  const files = new Map();
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0 && at + ENTRY_BYTES <= end && view.getUint32(at, true) === ENTRY; left--) {
    const method = view.getUint16(at + 10, true), bytes = view.getUint32(at + 20, true), local = view.getUint32(at + 42, true);
    const [name, extra, comment] = [28, 30, 32].map((place) => view.getUint16(at + place, true));
    files.set(new TextDecoder().decode(data.subarray(at + ENTRY_BYTES, at + ENTRY_BYTES + name)), async () => {
      const begin = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true), packed = data.subarray(begin, begin + bytes);
      if (method === STORED) return packed;
      if (method !== DEFLATED) throw new SceneError(words.scene.unreadable);
      return new Uint8Array(await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate-raw"))).arrayBuffer());
    });
    at += ENTRY_BYTES + name + extra + comment;
  }
  return files;
}
