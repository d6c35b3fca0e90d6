// @ts-check
/**
 * Reader of PlayCanvas' SOG, a ZIP archive of WebP images, as `sgsst_core/files/formats/sog.py` describes it, and of
 * the finest level of a streamed SOG in an archive, as in `streamed_sog.py` there.
 *
 * Pixel i of each image belongs to Gaussian i. Images are decoded by the browser and read back from a texture, because
 * a canvas would round the colors of transparent pixels.
 */
import { SceneError, unzipped } from "./byte_reader.js";
import { COLOR, HARMONICS, LOGITS, OPACITY, ROTATION, SCALES, setRotation, unpacked } from "./packing.js";
import { extrasRendering } from "./render_tag.js";
import { words } from "../words.js";

/** @typedef {import("./byte_reader.js").Files} Files */
/** @typedef {import("./scene_file.js").SceneFile} SceneFile */

/** SH coefficients per color channel by the width of the palette's image, which has 64 vectors in a row. */
const COEFFICIENTS = /** @type {Record<number, number>} */ ({ 192: 3, 512: 8, 960: 15 });
/** Alpha of the rotations' image for w as the largest component; x, y and z follow. */
const FIRST_TAG = 252;
/** Direction from which SuperSplat shows a scene first, where up is -y. */
const SUPERSPLAT = [-1, 0, 1];
const MAX_PALETTE_PIXELS = 65536 * 15;
const META = "meta.json", INDEX = "lod-meta.json";

/**
 * @typedef {object} Part SOG scene, alone or as a part of a streamed one
 * @property {number} count number of Gaussians
 * @property {number} coefficients SH coefficients per color channel above degree 0
 * @property {import("./render_tag.js").Rendering} rendering
 * @property {(begin: number, into: Float32Array, o: number, width: number, some: number, stride: number) => Promise<void>} fill
 *   writes the rows of `some` Gaussians to `into` from `o` on; `stride` is the number of coefficients in a row
 */

/** @param {import("./byte_reader.js").ByteReader} reader @returns {Promise<SceneFile>} */
export async function sog(reader) {
  const files = await unzipped(await reader.all());
  const [index] = [...files.keys()].filter((name) => `/${name}`.endsWith(`/${INDEX}`)).sort((a, b) => a.length - b.length);
  if (index === undefined && !files.has(META)) throw new SceneError(words.scene.notScene);
  return { ...joined(index === undefined ? [await sogPart(files)] : await finestParts(files, index)), front: SUPERSPLAT };
}

/** Return the parts of the finest level, and the environment. @param {Files} files @param {string} name of the index */
async function finestParts(files, name) {
  const above = name.slice(0, -INDEX.length), { filenames, environment, tree } = await json(files, name);
  const used = /** @type {Map<number, Set<number>>} */ (new Map());
  const visit = (/** @type {any} */ node) => {
    for (const [level, { file }] of Object.entries(node.lods ?? {})) used.set(Number(level), (used.get(Number(level)) ?? new Set()).add(file));
    (node.children ?? []).forEach(visit);
  };
  visit(tree);
  const numbers = [...used.get(Math.min(...used.keys())) ?? []].sort((a, b) => a - b), parts = [];
  for (const each of [...numbers.map((number) => filenames[number]), ...environment ? [environment] : []]) {
    const folder = above + each.slice(0, -META.length), inside = [...files].filter(([path]) => path.startsWith(folder));
    parts.push(await sogPart(new Map(inside.map(([path, load]) => [path.slice(folder.length), load]))));
  }
  return parts;
}

/** @param {Files} files @param {string} name @returns {Promise<any>} */
async function json(files, name) {
  const load = files.get(name);
  if (!load) throw new SceneError();
  return JSON.parse(new TextDecoder().decode(await load()));
}

/** Return a scene of the Gaussians of some parts. @param {Part[]} parts @returns {SceneFile} */
function joined(parts) {
  const coefficients = Math.max(...parts.map((part) => part.coefficients)), count = parts.reduce((sum, part) => sum + part.count, 0);
  return unpacked(count, Math.sqrt(coefficients + 1) - 1, async (begin, into, width, some) => {
    let first = 0;
    for (const part of parts) {
      const from = Math.max(begin, first), to = Math.min(begin + some, first + part.count);
      if (from < to) await part.fill(from - first, into, (from - begin) * width, width, to - from, coefficients);
      first += part.count;
    }
  }, parts[0].rendering);
}

/** @param {Files} files @returns {Promise<Part>} */
async function sogPart(files) {
  const meta = await json(files, META);
  const { version = 1, means, scales, quats, sh0, shN } = meta, table = version === 2 ? codebook : steps;
  if (version !== 1 && version !== 2) throw new SceneError(words.scene.newSog);
  const count = version === 2 ? meta.count : means.shape[0];
  if (!(Number.isInteger(count) && count > 0)) throw new SceneError(words.scene.notGaussians);
  const image = async (/** @type {any} */ entry, index = 0) => (await decoded(files, entry.files[index], count, 2 * count + 65536)).bytes;
  const palette = shN && await decoded(files, shN.files[0], 1, MAX_PALETTE_PIXELS);
  const coefficients = palette ? COEFFICIENTS[palette.width] : 0;
  if (coefficients === undefined) throw new SceneError();
  const [low, high] = [means.mins, means.maxs].map((side) => Float64Array.from(side));
  const scaleOf = table(scales, 3), colorOf = table(sh0, 4), harmonicOf = shN && table(shN, 1);
  const opacityOf = version === 2 ? LOGITS : colorOf[3];
  const all = async () => ({
    lows: await image(means), highs: await image(means, 1), scale: await image(scales), rotation: await image(quats),
    color: await image(sh0), label: shN ? await image(shN, 1) : new Uint8Array(0),
  });
  /** @type {Awaited<ReturnType<typeof all>> | null} */
  let read = null;
  const fill = async (/** @type {number} */ begin, /** @type {Float32Array} */ into, /** @type {number} */ o, /** @type {number} */ width, /** @type {number} */ some, /** @type {number} */ stride) => {
    const { lows, highs, scale, rotation, color, label } = read ??= await all();
    for (let i = 0, p = 4 * begin; i < some; i++, p += 4, o += width) {
      for (let axis = 0; axis < 3; axis++) {
        const step = (lows[p + axis] | (highs[p + axis] << 8)) / 65535, value = low[axis] + (high[axis] - low[axis]) * step;
        into[o + axis] = Math.sign(value) * Math.expm1(Math.abs(value));
        into[o + SCALES + axis] = scaleOf[axis][scale[p + axis]];
        into[o + COLOR + axis] = colorOf[axis][color[p + axis]];
      }
      into[o + OPACITY] = opacityOf[color[p + 3]];
      const largest = rotation[p + 3] - FIRST_TAG;
      if (largest < 0) throw new SceneError();
      setRotation(into, o + ROTATION, largest, [0, 1, 2].map((part) => (rotation[p + part] / 255 - 0.5) * Math.SQRT2));
      for (let n = 0; n < coefficients; n++) {
        const v = 4 * ((label[p] | (label[p + 1] << 8)) * coefficients + n);
        if (v >= palette.bytes.length) throw new SceneError();
        for (let c = 0; c < 3; c++) into[o + HARMONICS + c * stride + n] = harmonicOf[0][palette.bytes[v + c]];
      }
    }
  };
  return { count, coefficients, fill, rendering: extrasRendering({ ...meta.extras, model: meta.model }) };
}

/**
 * Return the values of each byte, the same for all channels. Older writers left the first value empty: it is the second
 * one less the mean step of the others.
 *
 * @param {any} entry
 * @param {number} channels
 * @returns {Float32Array[]}
 */
function codebook({ codebook: values }, channels) {
  const numbers = Float32Array.from(values), last = numbers.length - 1;
  if (values[0] === null) numbers[0] = values[1] + (values[1] - values[last]) / 255;
  return Array(channels).fill(numbers);
}

/** Return the values of each byte in version 1, by channel. @param {any} entry @param {number} channels */
function steps({ mins, maxs }, channels) {
  const low = [mins].flat(), high = [maxs].flat();
  return Array.from({ length: channels }, (_, c) => Float32Array.from({ length: 256 }, (_, i) => low[c] + (high[c] - low[c]) * (i / 255)));
}

/** @type {WebGL2RenderingContext | null} */
let context = null;

/**
 * Decode a lossless WebP image.
 *
 * @param {Files} files
 * @param {string} name
 * @param {number} least minimum number of pixels
 * @param {number} most maximum number of pixels
 * @returns {Promise<{width: number, bytes: Uint8Array}>} RGBA
 */
async function decoded(files, name, least, most) {
  const content = await files.get(name)?.();
  if (!content) throw new SceneError();
  const image = await createImageBitmap(new Blob([content]), { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  const { width, height } = image, gl = context ??= new OffscreenCanvas(1, 1).getContext("webgl2");
  if (!gl || width * height < least || width * height > most) throw new SceneError();
  const texture = gl.createTexture(), frame = gl.createFramebuffer(), bytes = new Uint8Array(4 * width * height);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  gl.deleteFramebuffer(frame);
  gl.deleteTexture(texture);
  image.close();
  return { width, bytes };
}
