// @ts-check
/**
 * Reader of GLB with KHR_gaussian_splatting, converted to rows of PLY values.
 *
 * Files with float32 attributes and without node transformations are shown, as splat-transform and sgsst write them.
 */
import { SceneError } from "./byte_reader.js";
import { HARMONICS, OPACITY, ROTATION, SCALES, COLOR, unpacked } from "./packed.js";
import { extrasRendering } from "./render_tag.js";
import { words } from "../words.js";

/** @typedef {import("./byte_reader.js").ByteReader} ByteReader */
/** @typedef {import("./scene_file.js").SceneFile} SceneFile */

const EXTENSION = "KHR_gaussian_splatting", FLOAT = 5126, MAX_JSON = 1 << 20;
const TYPES = /** @type {Record<string, number>} */ ({ SCALAR: 1, VEC3: 3, VEC4: 4 });
const NAMES = ["POSITION", ...["ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"].map((name) => `${EXTENSION}:${name}`)];
/**
 * Signs of the harmonics' coefficients of degree 1 to 3 under a half rotation about z, from glTF's axes (y up) to those
 * of a PLY.
 */
const ROTATED = [-1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1];

/**
 * @param {ByteReader} reader
 * @returns {Promise<SceneFile>}
 */
export async function glb(reader) {
  const head = new DataView((await reader.take(20)).buffer), size = head.getUint32(12, true);
  if (head.getUint32(4, true) !== 2 || size > MAX_JSON) throw new SceneError(words.scene.unreadable);
  const text = new TextDecoder().decode(await reader.take(size));
  const bytes = new DataView((await reader.take(8)).buffer).getUint32(0, true);
  const { parts, degree, rendering } = partsOf(text, bytes), coefficients = (degree + 1) ** 2 - 1;
  const count = parts.reduce((sum, part) => sum + part.count, 0);
  /** @type {DataView | null} */
  let data = null;
  let current = 0, first = 0; // batches are read in order
  return unpacked(count, degree, async (begin, into, width, some) => {
    data ??= new DataView((await reader.take(bytes)).buffer);
    for (let i = 0; i < some; i++) {
      while (begin + i >= first + parts[current].count) first += parts[current++].count;
      unpack(data, parts[current].places, begin + i - first, into, i * width, coefficients);
    }
  }, rendering);
}

/** @typedef {{offset: number, stride: number}} Place place of an attribute's values in the data */

/** @typedef {{count: number, places: Place[]}} Part set of Gaussians: places of `NAMES`, then of harmonics */

/**
 * Return all sets of Gaussians, their largest SH degree and their render mode.
 *
 * @param {string} text the JSON document
 * @param {number} bytes size of the data
 */
function partsOf(text, bytes) {
  try {
    return partsIn(JSON.parse(text), bytes);
  } catch (error) {
    throw error instanceof SceneError ? error : new SceneError(words.scene.unreadable); // values are missing
  }
}

/**
 * @param {any} document
 * @param {number} bytes
 */
function partsIn({ accessors, bufferViews, meshes, nodes = [] }, bytes) {
  const isSplats = (/** @type {any} */ each) => Boolean(each.extensions?.[EXTENSION]);
  const shown = nodes.map((/** @type {any} */ node) => meshes[node.mesh]).filter((/** @type {any} */ mesh) => mesh?.primitives.some(isSplats));
  const primitives = (shown.length ? shown : meshes).flatMap((/** @type {any} */ mesh) => mesh.primitives).filter(isSplats);
  if (!primitives.length) throw new SceneError(words.scene.noSplats);
  const plain = nodes.every((/** @type {any} */ node) => !node.matrix && !node.rotation && !node.scale && !node.translation);
  /** @type {Part[]} */
  const parts = primitives.map((/** @type {any} */ primitive) => partOf(primitive, accessors, bufferViews, bytes));
  const count = parts.reduce((sum, part) => sum + part.count, 0);
  if (!plain || !(count <= bytes)) throw new SceneError(words.scene.notShown("This kind of GLB"));
  const degree = Math.max(...parts.map(({ places }) => Math.sqrt(places.length - NAMES.length + 1) - 1));
  return { parts, degree, rendering: extrasRendering(primitives[0].extras) };
}

/**
 * @param {any} primitive
 * @param {any} accessors
 * @param {any} bufferViews
 * @param {number} bytes
 * @returns {Part}
 */
function partOf(primitive, accessors, bufferViews, bytes) {
  const names = [...NAMES];
  let degree = 0;
  for (; degree < 3 && `${EXTENSION}:SH_DEGREE_${degree + 1}_COEF_0` in primitive.attributes; degree++) {
    for (let i = 0; i < 2 * degree + 3; i++) names.push(`${EXTENSION}:SH_DEGREE_${degree + 1}_COEF_${i}`);
  }
  const count = Number(accessors[primitive.attributes.POSITION].count);
  const places = names.map((name) => {
    const { bufferView, byteOffset = 0, componentType, type, sparse } = accessors[primitive.attributes[name]], view = bufferViews[bufferView];
    const stride = view.byteStride ?? 4 * TYPES[type], offset = (view.byteOffset ?? 0) + byteOffset;
    const inside = count > 0 && offset >= 0 && stride > 0 && offset + (count - 1) * stride + 4 * TYPES[type] <= bytes;
    if (componentType !== FLOAT || sparse || !inside) throw new SceneError(words.scene.notShown("This kind of GLB"));
    return { offset, stride };
  });
  return { count, places };
}

/**
 * @param {DataView} data
 * @param {Place[]} places
 * @param {number} i index of the Gaussian
 * @param {Float32Array} into
 * @param {number} o offset of its row
 * @param {number} coefficients number of harmonics per color channel in a row, which may be more than the part has
 */
function unpack(data, places, i, into, o, coefficients) {
  const [position, rotation, scale, opacity, color] = places.map(({ offset, stride }) => offset + i * stride);
  const value = (/** @type {number} */ at, /** @type {number} */ part) => data.getFloat32(at + 4 * part, true);
  for (let axis = 0; axis < 3; axis++) {
    into[o + axis] = value(position, axis) * (axis < 2 ? -1 : 1);
    into[o + SCALES + axis] = Math.log(value(scale, axis));
    into[o + COLOR + axis] = value(color, axis);
  }
  const alpha = Math.min(Math.max(value(opacity, 0), 1e-7), 1 - 1e-7);
  into[o + OPACITY] = Math.log(alpha / (1 - alpha));
  into[o + ROTATION] = -value(rotation, 2);
  into[o + ROTATION + 1] = -value(rotation, 1);
  into[o + ROTATION + 2] = value(rotation, 0);
  into[o + ROTATION + 3] = value(rotation, 3);
  for (let n = 0; n < places.length - NAMES.length; n++) {
    const { offset, stride } = places[NAMES.length + n];
    for (let c = 0; c < 3; c++) into[o + HARMONICS + c * coefficients + n] = ROTATED[n] * value(offset + i * stride, c);
  }
}
