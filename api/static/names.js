// @ts-check
/** Names of jobs, and labels that tell jobs apart. */
import { sceneSuffix } from "./tables.js";
import { time, words } from "./words.js";

/** @param {string} name @returns {string} name of an image without its suffix */
const stem = (name) => name.replace(/\.[^.]*$/, "");

/** Return a job's default name, or the scene's. @param {string | undefined} scene @param {string[]} styles names */
export function defaultName(scene, styles) {
  if (!scene) return "";
  const suffix = sceneSuffix(scene), plain = suffix ? scene.slice(0, -suffix.length) : stem(scene);
  return styles.length ? `${plain} · ${styles.map(stem).join(" + ")}` : plain;
}

/** Return the names of the paintings of a region. @param {any} region @returns {string[]} */
export const paintingsOf = ({ style }) => [style ?? []].flat().map((/** @type {string} */ text) => text.replace(/:[\d.e+-]+$/, ""));

/** Return the names of a job's style images, and those of its regions: "night; sky: wave". @param {any} job @returns {string} */
export function stylesOf(job) {
  const painted = (job.parameters?.regions ?? []).filter((/** @type {any} */ region) => region.style), taken = new Set(painted.flatMap(paintingsOf));
  const own = job.inputs.filter((/** @type {any} */ { role, name }) => role === "style" && !taken.has(name)).map((/** @type {any} */ { name }) => stem(name));
  return [own.join(" + "), ...painted.map((/** @type {any} */ region) => `${region.name}: ${paintingsOf(region).map(stem).join(" + ")}`)].filter(Boolean).join("; ");
}

/** @param {any} job @returns {string} */
export const nameOf = (job) => job.name || words.job.unnamed;

/** Return what a view of a job calls its result. @param {any} job */
export const resultName = ({ parameters }) => (parameters?.painted?.length ? words.viewer.painted : words.viewer.stylized);

/** Return distinct labels: styles; if equal, names, times and numbers too. @param {any[]} jobs @returns {string[]} */
export function labels(jobs) {
  let found = jobs.map(stylesOf);
  for (const way of [nameOf, (/** @type {any} */ job) => time(job.created_at)]) {
    const before = found, texts = jobs.map(way);
    found = before.map((text, i) => (jobs.some((_, k) => before[k] === text && texts[k] !== texts[i]) ? `${text}, ${texts[i]}` : text));
  }
  const number = (/** @type {number} */ i) => found.slice(0, i + 1).filter((each) => each === found[i]).length;
  return found.map((text, i) => (found.indexOf(text) === found.lastIndexOf(text) ? text : `${text} (${number(i)})`));
}

/** Return a text as part of a file name. @param {string} text */
export const fileName = (text) => text.replace(/[^\p{L}\p{N}._-]+/gu, "_").replace(/^[._]+|[._]+$/g, "").slice(0, 80);
