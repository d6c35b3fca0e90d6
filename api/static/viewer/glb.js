// @ts-check
/**
 * Reader of GLB with KHR_gaussian_splatting, converted to rows of PLY values.
 *
 * Nodes may move, rotate and evenly scale the Gaussians. Files with distorting nodes or sparse values are not shown.
 */
import { SceneError } from "./byte_reader.js";
import { cross, dot, rotatedHarmonics, times, turnOf, unit } from "./vectors.js";
import { COLOR, HARMONICS, OPACITY, ROTATION, SCALES, unpacked } from "./packing.js";
import { extrasRendering } from "./render_tag.js";
import { words } from "../words.js";

/** @typedef {import("./vectors.js").Vector} Vector */

const EXTENSION = "KHR_gaussian_splatting", MAX_JSON = 1 << 20, MAX_DEPTH = 64;
/** Readers of component types: method of a DataView, bytes, and the integer that stands for 1 if integers are normalized. */
const COMPONENTS = /** @type {Record<number, ["getInt8" | "getUint8" | "getInt16" | "getUint16" | "getFloat32", number, number]>} */ ({
  5120: ["getInt8", 1, 127], 5121: ["getUint8", 1, 255], 5122: ["getInt16", 2, 32767], 5123: ["getUint16", 2, 65535], 5126: ["getFloat32", 4, 1],
});
const TYPES = /** @type {Record<string, number>} */ ({ SCALAR: 1, VEC3: 3, VEC4: 4 });
const NAMES = ["POSITION", ...["ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"].map((name) => `${EXTENSION}:${name}`)];
/** Rows of the half rotation about z from glTF's axes (y up) to those of a PLY. */
const Y_UP = [[-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0]];
/** Maximum deviation of a node's matrix from a rotation, relative to its scale. */
const TOLERANCE = 1e-4;

/** @param {import("./byte_reader.js").ByteReader} reader @returns {Promise<import("./scene_file.js").SceneFile>} */
export async function glb(reader) {
  const head = new DataView((await reader.take(20)).buffer), size = head.getUint32(12, true);
  if (head.getUint32(4, true) !== 2 || size > MAX_JSON) throw new SceneError();
  const text = new TextDecoder().decode(await reader.take(size));
  const bytes = new DataView((await reader.take(8)).buffer).getUint32(0, true);
  const { parts, degree, rendering } = partsOf(text, bytes), coefficients = (degree + 1) ** 2 - 1;
  const count = parts.reduce((sum, part) => sum + part.count, 0);
  /** @type {DataView | null} */
  let data = null;
  let current = 0, first = 0; // batches are read in order
  return unpacked(count, degree, async (begin, into, width, some) => {
    data ??= new DataView((await reader.take(bytes)).buffer);
    for (let i = begin, o = 0; i < begin + some; i++, o += width) {
      while (i >= first + parts[current].count) first += parts[current++].count;
      const { readers, scale: larger, axes, moved, turn: [a, b, c, d], harmonics: rotated } = parts[current], row = i - first;
      const [position, rotation, scale, opacity, color, ...harmonics] = readers.map((read) => (/** @type {number} */ part) => read(/** @type {DataView} */ (data), row, part));
      const at = [position(0), position(1), position(2)], [x, y, z, w] = [rotation(0), rotation(1), rotation(2), rotation(3)];
      for (let axis = 0; axis < 3; axis++) {
        into[o + axis] = larger * dot(axes[axis], at) + moved[axis];
        into[o + SCALES + axis] = Math.log(larger * scale(axis));
        into[o + COLOR + axis] = color(axis);
      }
      const alpha = Math.min(Math.max(opacity(0), 1e-7), 1 - 1e-7);
      into[o + OPACITY] = Math.log(alpha / (1 - alpha));
      into[o + ROTATION] = a * w - b * x - c * y - d * z;
      into[o + ROTATION + 1] = a * x + b * w + c * z - d * y;
      into[o + ROTATION + 2] = a * y - b * z + c * w + d * x;
      into[o + ROTATION + 3] = a * z + b * y - c * x + d * w;
      for (let n = 0; n < harmonics.length; n++) {
        for (let channel = 0; channel < 3; channel++) {
          into[o + HARMONICS + channel * coefficients + n] = rotated[n].reduce((sum, [before, factor]) => sum + factor * harmonics[before](channel), 0);
        }
      }
    }
  }, rendering);
}

/** @typedef {(data: DataView, i: number, part: number) => number} Reader reads a part of the attribute of Gaussian i */

/** @typedef {{scale: number, axes: Vector[], moved: Vector, turn: number[], harmonics: [number, number][][]}} Pose scale of a node, rows of its rotation, its translation, and the rotation as a quaternion (wxyz) and of harmonics */

/** @typedef {Pose & {count: number, readers: Reader[]}} Part set of Gaussians: readers of `NAMES`, then of harmonics */

/** Return all sets of Gaussians, their largest SH degree and render mode. @param {string} text @param {number} bytes */
function partsOf(text, bytes) {
  const { accessors, bufferViews, meshes, nodes = [] } = JSON.parse(text);
  const isSplats = (/** @type {any} */ each) => Boolean(each.extensions?.[EXTENSION]);
  /** @type {{primitives: any[], pose: Pose}[]} */
  const shown = nodes.flatMap((/** @type {any} */ node, /** @type {number} */ i) => {
    const primitives = meshes[node.mesh]?.primitives.filter(isSplats) ?? [];
    return primitives.length ? [{ primitives, pose: poseOf(nodes, i) }] : [];
  });
  const still = meshes.map((/** @type {any} */ mesh) => ({ primitives: mesh.primitives.filter(isSplats), pose: poseOf([{}], 0) }));
  const used = shown.length ? shown : still, [first] = used.flatMap((/** @type {any} */ each) => each.primitives);
  if (!first) throw new SceneError(words.scene.noSplats);
  /** @type {Part[]} */
  const parts = used.flatMap((/** @type {any} */ { primitives, pose }) => primitives.map((/** @type {any} */ primitive) => ({ ...pose, ...partOf(primitive, accessors, bufferViews, bytes) })));
  const count = parts.reduce((sum, part) => sum + part.count, 0);
  if (!(count <= bytes)) throw new SceneError(words.scene.notShown("This kind of GLB"));
  const degree = Math.max(...parts.map(({ readers }) => Math.sqrt(readers.length - NAMES.length + 1) - 1));
  return { parts, degree, rendering: extrasRendering(first.extras) };
}

/** Return the pose of a node, below those above it. @param {any[]} nodes @param {number} index @returns {Pose} */
function poseOf(nodes, index) {
  let rows = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], depth = 0;
  for (let at = index; at >= 0 && depth <= MAX_DEPTH; at = nodes.findIndex(({ children = [] }) => children.includes(at)), depth++) rows = product(rowsOf(nodes[at]), rows);
  rows = product(Y_UP, rows);
  const scale = Math.cbrt(dot(cross(rows[0], rows[1]), rows[2]));
  const even = rows.every((row, i) => rows.every((other, j) => Math.abs(dot(row, other) - (i === j ? scale ** 2 : 0)) <= TOLERANCE * scale ** 2));
  if (!(scale > 0) || !even || depth > MAX_DEPTH) throw new SceneError(words.scene.notShown("This kind of GLB"));
  const axes = rows.map((row) => times(row.slice(0, 3), 1 / scale));
  return { scale, axes, moved: rows.map((row) => row[3]), turn: quaternionOf(axes), harmonics: rotatedHarmonics(axes) };
}

/** Return the rows of a node's own transformation, each with its part of the translation. @param {any} node */
function rowsOf({ matrix, rotation = [0, 0, 0, 1], scale = [1, 1, 1], translation = [0, 0, 0] }) {
  if (matrix) return [0, 1, 2].map((row) => [0, 1, 2, 3].map((column) => matrix[4 * column + row]));
  return turnOf(unit(rotation)).map((row, i) => [...row.map((value, j) => value * scale[j]), translation[i]]);
}

/** Return the rows of a transformation that follows another one. @param {number[][]} last @param {number[][]} first */
const product = (last, first) => last.map((row) => [0, 1, 2, 3].map((column) => dot(row, first.map((each) => each[column])) + (column === 3 ? row[3] : 0)));

/** Return a rotation as a unit quaternion (wxyz): the longest of four multiples of it. @param {Vector[]} rows */
function quaternionOf([[a, b, c], [d, e, f], [g, h, i]]) {
  const multiples = [[1 + a + e + i, h - f, c - g, d - b], [h - f, 1 + a - e - i, b + d, c + g], [c - g, b + d, 1 - a + e - i, f + h], [d - b, c + g, f + h, 1 - a - e + i]];
  return unit(multiples.reduce((best, each) => (Math.hypot(...each) > Math.hypot(...best) ? each : best)));
}

/** @param {any} primitive @param {any} accessors @param {any} bufferViews @param {number} bytes */
function partOf(primitive, accessors, bufferViews, bytes) {
  const names = [...NAMES];
  let degree = 0;
  for (; degree < 3 && `${EXTENSION}:SH_DEGREE_${degree + 1}_COEF_0` in primitive.attributes; degree++) {
    for (let i = 0; i < 2 * degree + 3; i++) names.push(`${EXTENSION}:SH_DEGREE_${degree + 1}_COEF_${i}`);
  }
  const count = Number(accessors[primitive.attributes.POSITION].count);
  /** @type {Reader[]} */
  const readers = names.map((name) => {
    const { bufferView, byteOffset = 0, componentType, type, normalized, sparse } = accessors[primitive.attributes[name]], view = bufferViews[bufferView];
    const [method, size, largest] = COMPONENTS[componentType] ?? ["getFloat32", NaN, 1];
    const stride = view.byteStride ?? size * TYPES[type], offset = (view.byteOffset ?? 0) + byteOffset;
    const inside = count > 0 && offset >= 0 && stride > 0 && offset + (count - 1) * stride + size * TYPES[type] <= bytes;
    if (sparse || !inside) throw new SceneError(words.scene.notShown("This kind of GLB"));
    /** @type {Reader} */
    const read = (data, i, part) => data[method](offset + i * stride + size * part, true);
    return normalized && largest > 1 ? (data, i, part) => Math.max(read(data, i, part) / largest, -1) : read;
  });
  return { count, readers };
}
