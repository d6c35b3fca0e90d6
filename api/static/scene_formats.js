// @ts-check
/** Scene formats that the service reads. The server fills in its registry. */

/**
 * @typedef {object} SceneFormat
 * @property {string} name name in requests
 * @property {string} suffix file name suffix, such as ".compressed.ply"
 * @property {string} title
 * @property {boolean} result whether results can be downloaded in this format
 */

/** @type {SceneFormat[]} */
export const sceneFormats = /** @type {any} */ ("{{scene_formats}}");

/** Formats of a downloaded result, PLY first. @type {{ name: string, title: string }[]} */
export const downloads = /** @type {any} */ ("{{downloads}}");

/** Formats of results, PLY first. */
export const resultFormats = sceneFormats.filter(({ result }) => result);

/** Titles of all formats, without variants such as compressed PLY: "PLY, SPZ or .splat". */
export const titles = sceneFormats.filter(({ suffix }) => suffix.lastIndexOf(".") === 0).map(({ title }) => title).join(", ").replace(/, ([^,]*)$/, " or $1");

/** Value of the attribute `accept` of a file input: the last part of each suffix. */
export const accepted = [...new Set(sceneFormats.map(({ suffix }) => suffix.slice(suffix.lastIndexOf("."))))].join();

/** Return the suffix of a scene file, by its name; "" for other files. @param {string} name */
export function sceneSuffix(name) {
  const fitting = sceneFormats.map(({ suffix }) => suffix).filter((suffix) => name.toLowerCase().endsWith(suffix));
  return fitting.reduce((longest, suffix) => (suffix.length > longest.length ? suffix : longest), "");
}
