// @ts-check
/** Tables that the server fills in: statuses of jobs and their actions, formats of scenes, and installed extras. */

/** @type {{ titles: Record<string, string>, unfinished: string[], working: string[], stepping: string[], actions: { name: string, title: string, statuses: string[] }[] }} */
const states = /** @type {any} */ ("{{job_states}}");

/** Text to display for each status. */
export const statusTitles = states.titles;
/** Return the fraction of its steps that a job has made; undefined unless it makes steps. @param {any} job */
export const stepFraction = ({ status, progress }) => (states.stepping.includes(status) && progress?.total ? progress.fraction : undefined);
export const UNFINISHED = new Set(states.unfinished), WORKING = new Set(states.working);

/** Return the actions that a status allows, `POST /v1/jobs/{id}/{name}`, with their titles. @param {string} status */
export const actionsOf = (status) => states.actions.filter((action) => action.statuses.includes(status));

/** `result`: whether results have it. @type {{ name: string, suffix: string, title: string, result: boolean }[]} */
export const sceneFormats = /** @type {any} */ ("{{scene_formats}}");

/** Formats of a downloaded result, PLY first. @type {{ name: string, title: string }[]} */
export const downloads = /** @type {any} */ ("{{downloads}}");

/** Formats of results, PLY first. */
export const resultFormats = sceneFormats.filter(({ result }) => result);

/** Titles of all formats, without variants such as compressed PLY: "PLY, SPZ or .splat". */
export const sceneTitles = sceneFormats.filter(({ suffix }) => suffix.lastIndexOf(".") === 0).map(({ title }) => title).join(", ").replace(/, ([^,]*)$/, " or $1");

/** Value of the attribute `accept` of a file input: the last part of each suffix. */
export const accepted = [...new Set(sceneFormats.map(({ suffix }) => suffix.slice(suffix.lastIndexOf("."))))].join();

/** Return the suffix of a scene file, by its name; "" for other files. @param {string} name */
export function sceneSuffix(name) {
  const fitting = sceneFormats.map(({ suffix }) => suffix).filter((suffix) => name.toLowerCase().endsWith(suffix));
  return fitting.reduce((longest, suffix) => (suffix.length > longest.length ? suffix : longest), "");
}

/** @type {{video: boolean, heif: boolean}} */
export const installed = /** @type {any} */ ("{{installed_extras}}");
