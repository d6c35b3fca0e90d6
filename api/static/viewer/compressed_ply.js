// @ts-check
/** Reader of PlayCanvas' compressed PLY. Its layout is that of github.com/playcanvas/splat-transform. */
import { SceneError } from "./byte_reader.js";
import { COLOR, HARMONICS, LOGITS, OPACITY, ROTATION, SCALES, SH_C0, setRotation, unpacked } from "./packed.js";
import { DEGREES, floats } from "./ply.js";
import { plyRendering } from "./render_tag.js";
import { words } from "../words.js";

/** @typedef {import("./byte_reader.js").ByteReader} ByteReader */
/** @typedef {import("./scene_file.js").SceneFile} SceneFile */

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
  const wrong = chunk.name !== "chunk" || !chunk.little || vertex?.name !== "vertex" || !(vertex.count > 0) || vertex.stride !== 16
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
