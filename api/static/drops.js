// @ts-check
/** Files of a new job: dropped on the page, sorted by their names, and checked by their content as far as the page can. */
import { h } from "./dom.js";
import { sceneSuffix } from "./scene_formats.js";
import { words } from "./words.js";

const say = words.contents;
/** Starts of images that browsers decode, and the suffixes that promise one. */
const STARTS = ["\xff\xd8\xff", "\x89PNG", "RIFF", "GIF8", "BM"], DECODED = /\.(png|jpe?g|webp|gif|bmp)$/i;
/** Bytes above which an image is not decoded for the check. */
const LARGE = 5e7;
/** Names of the files of a COLMAP model. */
const MODEL = /^(cameras|images|points3D|frames|rigs)[^/]*\.(bin|txt)$/i;
const PICTURE = /\.(png|jpe?g|webp|tiff?|bmp|heic|heif|hif)$/i;

/**
 * Sort dropped files into slots. Up to four images are styles; more are photos.
 *
 * @param {File[]} files
 * @returns {{scene: File[], style: File[], cameras: File[], photos: File[], unknown: File[]}}
 */
export function sorted(files) {
  const pictures = files.filter((file) => PICTURE.test(file.name)), many = pictures.length > 4;
  const [scene, ...others] = files.filter((file) => sceneSuffix(file.name));
  return {
    scene: scene ? [scene] : [], cameras: files.filter((file) => namesCameras(file.name)),
    style: many ? [] : pictures, photos: many ? pictures : [],
    unknown: [...others, ...files.filter(({ name }) => !PICTURE.test(name) && !namesCameras(name) && !sceneSuffix(name))],
  };
}

/** Return the files of a drop, including those in folders. @param {DataTransfer} data @returns {Promise<File[]>} */
async function droppedFiles(data) {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry?.()).filter((entry) => entry);
  if (!entries.some((entry) => entry?.isDirectory)) return [...data.files];
  /** @type {File[]} */
  const found = [];
  const walk = async (/** @type {any} */ entry) => {
    if (found.length > 10000) return;
    if (entry.isFile) found.push(await new Promise((done, wrong) => entry.file(done, wrong)));
    else {
      const reader = entry.createReader();
      for (;;) {
        const part = await new Promise((done, wrong) => reader.readEntries(done, wrong));
        if (!part.length) break;
        for (const each of part) await walk(each);
      }
    }
  };
  for (const entry of entries) await walk(entry);
  return found;
}

/**
 * Take files that are dropped anywhere on the page.
 *
 * @param {(files: File[]) => void} take
 * @param {AbortSignal} signal ends this
 */
export function listenToDrops(take, signal) {
  const hint = h("div.dropping", { "aria-hidden": "true" }, words.submit.dropNow);
  let depth = 0;
  document.addEventListener("dragenter", (event) => {
    if (!event.dataTransfer?.types.includes("Files")) return;
    if (!depth++) document.body.append(hint);
  }, { signal });
  document.addEventListener("dragleave", () => !--depth && hint.remove(), { signal });
  document.addEventListener("dragover", (event) => event.preventDefault(), { signal });
  document.addEventListener("drop", async (event) => {
    event.preventDefault();
    depth = 0;
    hint.remove();
    if (event.dataTransfer) take(await droppedFiles(event.dataTransfer));
  }, { signal });
}

/** Return whether a file may hold cameras, by its name. @param {string} name */
export const namesCameras = (name) => /\.json$/i.test(name) || MODEL.test(name);

/** @param {File} file @returns {Promise<string>} "" if nothing is wrong */
export async function imageProblem(file) {
  const start = String.fromCharCode(...new Uint8Array(await file.slice(0, 4).arrayBuffer()));
  if (!STARTS.some((each) => start.startsWith(each))) return DECODED.test(file.name) ? say.notImage(file.name) : "";
  if (file.size > LARGE) return "";
  return createImageBitmap(file).then((image) => (image.close(), ""), () => say.brokenImage(file.name));
}

/** @param {File} file @returns {Promise<string>} "" if nothing is wrong */
export async function camerasProblem(file) {
  if (!namesCameras(file.name)) return say.notCameras(file.name);
  if (MODEL.test(file.name)) return "";
  return file.text().then(JSON.parse).then(() => "", () => say.notJson(file.name));
}
