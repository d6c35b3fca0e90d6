// @ts-check
/** Scenes of any form, told by their content: rows of float32, batch by batch, by the names of a PLY's properties. */
import { ByteReader, SceneError } from "./byte_reader.js";
import { compressedPly, isSplat, splat, spz } from "./packed.js";
import { plainPly, readHeader } from "./ply.js";
import { words } from "../words.js";

/**
 * @typedef {object} SceneFile
 * @property {number} count Gaussians
 * @property {number} degree of spherical harmonics
 * @property {number} width values of a row
 * @property {Record<string, number>} at place of each value in a row
 * @property {() => AsyncGenerator<Float32Array>} batches `BATCH` rows each, the last one fewer
 */

/**
 * @param {ByteReader} reader
 * @param {number} size bytes of the file; 0 where they are not known
 * @returns {Promise<SceneFile>}
 * @throws {SceneError}
 */
export async function openScene(reader, size) {
  const start = await reader.peek(4096), magic = String.fromCharCode(...start.subarray(0, 4));
  if (magic.startsWith("ply")) {
    const header = await readHeader(reader);
    return header.elements.some(({ name }) => name === "chunk") ? compressedPly(reader, header) : plainPly(reader, header);
  }
  if (start[0] === 0x1f && start[1] === 0x8b) return spz(reader);
  if (magic === "NGSP") throw new SceneError(words.scene.newSpz);
  if (isSplat(start, size)) return splat(reader, size);
  throw new SceneError(words.scene.notScene);
}
