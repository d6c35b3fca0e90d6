// @ts-check
/** Scenes of any format, detected from their content: batches of float32 rows, with names of PLY properties. */
import { ByteReader, SceneError } from "./byte_reader.js";
import { glb } from "./glb.js";
import { isKsplat, isSplat, ksplat, splat } from "./splat.js";
import { checkLength, compressedPly, plainPly, readHeader } from "./ply.js";
import { spz, spz4 } from "./spz.js";
import { sog } from "./sog.js";
import { words } from "../words.js";

/**
 * @typedef {object} SceneFile
 * @property {number} count number of Gaussians
 * @property {number} degree degree of spherical harmonics
 * @property {number} width number of values in a row
 * @property {Record<string, number>} at index of each value in a row
 * @property {import("./render_tag.js").Rendering} rendering
 * @property {number[]} [front] direction from which the program that writes the format shows a scene first
 * @property {() => AsyncGenerator<Float32Array>} batches `BATCH` rows each, fewer in the last one
 */

/** @param {ByteReader} reader @param {number} size bytes; 0 if unknown @returns {Promise<SceneFile>} */
export async function openScene(reader, size) {
  const start = await reader.peek(4096), magic = String.fromCharCode(...start.subarray(0, 4));
  if (magic.startsWith("ply")) {
    const header = await readHeader(reader);
    checkLength(header, size);
    return header.elements.some(({ name }) => name === "chunk") && !header.text ? compressedPly(reader, header) : plainPly(reader, header);
  }
  if (start[0] === 0x1f && start[1] === 0x8b) return spz(reader.piped(/** @type {any} */ (new DecompressionStream("gzip"))));
  if (magic === "NGSP") return start[4] < 4 ? spz(reader) : spz4(reader);
  if (magic === "glTF") return glb(reader);
  if (magic === "PK\x03\x04") return sog(reader);
  if (isKsplat(start)) return ksplat(reader);
  if (isSplat(start, size)) return splat(reader, size);
  throw new SceneError(words.scene.notScene);
}
