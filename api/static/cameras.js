// @ts-check
/** Cameras of a job: read from files, or on a ring around an object; and the lines that draw them as small frames. */
import { cross, difference, dot, sum, times, turnOf, unit } from "./viewer/vectors.js";
import { words } from "./words.js";

/** @typedef {import("./viewer/vectors.js").Vector} Vector */
/**
 * @typedef {{name: string, position: Vector, axes: Vector[], fx: number, fy: number, width: number, height: number}} JobCamera
 *   `axes`: right, down and forward in the world
 */

/** Cube faces of a panorama: their axes right, down and forward, as signed numbers of those of the panorama from 1. */
const FACES = { front: [1, 2, 3], right: [-3, 2, 1], back: [-1, 2, -3], left: [3, 2, -1], up: [1, 3, -2], down: [1, -3, 2] };
/** Numbers of parameters of COLMAP's camera models that are shown: both without a lens, and panoramas. */
const PARAMETERS = new Map([[0, 3], [1, 4], [17, 2]]);

/**
 * Read the cameras of camera files. The service supports more formats, and its reading is the one that counts.
 *
 * @param {{name: string, blob: Blob}[]} files
 * @returns {Promise<JobCamera[]>}
 */
export async function readCameras(files) {
  const named = (/** @type {string} */ name) => files.find((file) => file.name.toLowerCase().endsWith(name))?.blob;
  const images = named("images.bin"), intrinsics = named("cameras.bin");
  if (images && intrinsics) return colmapCameras(await images.arrayBuffer(), await intrinsics.arrayBuffer());
  for (const file of files.filter((each) => each.name.toLowerCase().endsWith(".json"))) {
    const content = JSON.parse(await file.blob.text());
    if (Array.isArray(content)) return content.map(inriaCamera);
    if (Array.isArray(content?.frames)) return byFace(content.frames.map((/** @type {any} */ frame) => transformsCameras({ ...content, ...frame })));
  }
  throw new Error(words.cameras.notReadHere);
}

/** @param {any} entry */
function inriaCamera(entry) {
  const { rotation, position, fx, fy, width, height } = entry;
  return checked({
    name: String(entry.img_name ?? entry.id ?? ""), position: position.map(Number),
    axes: [0, 1, 2].map((column) => [0, 1, 2].map((row) => Number(rotation[row][column]))), fx, fy, width, height,
  });
}

/** @param {any} values @returns {JobCamera[]} */
function transformsCameras(values) {
  const m = values.transform_matrix, column = (/** @type {number} */ k, sign = 1) => [0, 1, 2].map((row) => sign * Number(m[row][k]));
  const width = values.w ?? 800, height = values.h ?? 800;
  const pose = { name: String(values.file_path ?? ""), position: column(3), axes: [column(0), column(1, -1), column(2, -1)], width, height };
  if (/^(equirectangular|spherical)$/i.test(values.camera_model)) return cubeFaces(pose);
  const fx = values.fl_x ?? width / 2 / Math.tan((values.camera_angle_x ?? 0.8) / 2);
  return [checked({ ...pose, fx, fy: values.fl_y ?? fx })];
}

/** @param {ArrayBuffer} images @param {ArrayBuffer} intrinsics */
function colmapCameras(images, intrinsics) {
  /** @type {Map<number, number[]>} */
  const models = new Map();
  let view = new DataView(intrinsics), at = 8;
  for (let left = Number(view.getBigUint64(0, true)); left > 0; left--) {
    const id = view.getUint32(at, true), model = view.getInt32(at + 4, true), count = PARAMETERS.get(model);
    if (!count) throw new Error(words.cameras.notReadHere);
    const size = [Number(view.getBigUint64(at + 8, true)), Number(view.getBigUint64(at + 16, true))];
    const focal = [24, model === 1 ? 32 : 24].map((offset) => view.getFloat64(at + offset, true));
    models.set(id, count === 2 ? size : [...size, ...focal]);
    at += 24 + 8 * count;
  }
  view = new DataView(images);
  at = 8;
  const found = [];
  for (let left = Number(view.getBigUint64(0, true)); left > 0; left--) {
    const [w, x, y, z, ...t] = Array.from({ length: 7 }, (_, i) => view.getFloat64(at + 4 + 8 * i, true));
    const [width, height, ...focal] = models.get(view.getUint32(at + 60, true)) ?? [0, 0, 0, 0];
    let end = at + 64;
    while (view.getUint8(end)) end++;
    const name = new TextDecoder().decode(new Uint8Array(images, at + 64, end - at - 64));
    at = end + 9 + 24 * Number(view.getBigUint64(end + 1, true));
    const axes = turnOf([x, y, z, w]);
    const pose = { name, position: axes.map((axis, i) => times(axis, -t[i])).reduce(sum), axes, width, height };
    found.push({ name, cameras: focal.length ? [checked({ ...pose, fx: focal[0], fy: focal[1] })] : cubeFaces(pose) });
  }
  return byFace(found.sort((a, b) => (a.name < b.name ? -1 : 1)).map(({ cameras }) => cameras));
}

/** Return cube faces, as the service names and sizes them. @param {Omit<JobCamera, "fx" | "fy">} panorama */
function cubeFaces({ name, position, axes, width }) {
  const side = Math.ceil(width / Math.PI), size = { fx: side / 2, fy: side / 2, width: side, height: side };
  return Object.entries(FACES).map(([face, signed]) =>
    checked({ name: `${name}.${face}`, position, axes: signed.map((n) => times(axes[Math.abs(n) - 1], Math.sign(n))), ...size }));
}

/** Return the first camera of each image, then the further ones of panoramas, as the service does. @param {JobCamera[][]} images */
function byFace(images) {
  const most = Math.max(0, ...images.map((cameras) => cameras.length));
  return Array.from({ length: most }, (_, i) => images.flatMap((cameras) => cameras[i] ?? [])).flat();
}

/**
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number, world_to_camera: number[][]}} RestCamera
 *   `world_to_camera`: rows of the rotation, each with its element of the translation
 */

/** Return the camera that a request or an image states. @param {any} stated @returns {JobCamera} */
export function statedCamera({ fx, fy, width, height, world_to_camera: rows }) {
  const axes = rows.slice(0, 3).map((/** @type {any} */ row) => row.slice(0, 3).map(Number));
  const position = axes.map((/** @type {Vector} */ axis, /** @type {number} */ i) => times(axis, -rows[i][3])).reduce(sum);
  return checked({ name: "", position, axes, fx, fy, width, height });
}

/** @param {JobCamera} camera @returns {JobCamera} */
function checked(camera) {
  const { position, axes, fx, fy, width, height } = camera;
  const numbers = [...position, ...axes.flat(), fx, fy, width, height];
  if (numbers.length !== 16 || !numbers.every(Number.isFinite) || !(fx > 0 && fy > 0 && width > 0 && height > 0)) throw new Error(words.cameras.notReadHere);
  return camera;
}

/**
 * Return an approximate preview of the cameras of `orbit`. The service computes the actual ring from a better estimate
 * of the subject.
 *
 * @param {{center: Vector, radius: number, low: Vector, high: Vector}} middle
 * @param {{count: number, up: Vector, elevation: number, radius?: number}} ring elevation in degrees
 * @returns {JobCamera[]}
 */
export function ringCameras(middle, { count, up, elevation, radius }) {
  const center = middle.low.map((low, i) => (low + middle.high[i]) / 2), half = Math.hypot(...difference(middle.high, center));
  const distance = radius ?? 3.1 * half, slant = (elevation * Math.PI) / 180, axis = unit(up);
  const aside = unit(cross(axis, Math.abs(axis[2]) > 0.9 ? [1, 0, 0] : [0, 0, 1])), front = cross(aside, axis);
  return Array.from({ length: count }, (_, i) => {
    const turn = (2 * Math.PI * i) / count;
    const level = sum(times(aside, Math.sin(turn)), times(front, -Math.cos(turn)));
    const out = sum(times(level, Math.cos(slant)), times(axis, Math.sin(slant)));
    const position = sum(center, times(out, distance)), forward = times(out, -1), right = unit(cross(forward, axis));
    return { name: `${i + 1}`, position, axes: [right, cross(forward, right), forward], fx: 1.5, fy: 1.5, width: 1, height: 1 };
  });
}

/** Return lines of frames, as pairs of points. @param {JobCamera[]} cameras @param {number} size world units */
export function cameraLines(cameras, size) {
  return Float32Array.from(cameras.flatMap(({ position, axes: [right, down, forward], fx, fy, width, height }) => {
    const x = (size * width) / 2 / fx, y = (size * height) / 2 / fy;
    const corner = (/** @type {number} */ i, /** @type {number} */ j) => [times(right, i * x), times(down, j * y), times(forward, size)].reduce(sum, position);
    const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    return corners.flatMap((place, i) => [position, place, place, corners[(i + 1) % 4]]).flat();
  }));
}

/** Return the size of frames, world units. @param {JobCamera[]} cameras @param {{center: Vector} | null} middle */
export function frameSize(cameras, middle) {
  if (!cameras.length) return 1;
  const away = cameras.map(({ position }) => Math.hypot(...difference(position, middle?.center ?? [0, 0, 0]))).sort((a, b) => a - b);
  return 0.08 * (away[away.length >> 1] || 1);
}

/** Return the mean up direction of cameras. @param {JobCamera[]} cameras @returns {Vector} */
export function upOf(cameras) {
  const total = cameras.map(({ axes }) => times(axes[1], -1)).reduce(sum, [0, 0, 0]);
  return dot(total, total) > 1e-6 ? unit(total) : [0, -1, 0];
}
