// @ts-check
/** Draft of a new job: the content of its form, restored after another view or a reload. */
import { paintingsOf } from "./names.js";
import { allInputs, StoredFile } from "./stored.js";
import { strengthName } from "./strength.js";

/** @typedef {import("./stored.js").Chosen} Chosen */
/**
 * @typedef {object} Draft
 * @property {Record<string, any>} values values of the options
 * @property {string | undefined} preset
 * @property {boolean} orbiting
 * @property {Record<string, Chosen[]>} files by role; after a reload, only those that the service has
 * @property {Record<string, string[]>} expired names of files that the service has deleted, by role
 * @property {Record<string, string[]>} [lost] names of files to choose again since a reload, by role
 * @property {boolean} [again] whether it started from an earlier job
 * @property {any[]} regions
 * @property {Record<string, string>} weights shares of the paintings in a blend, by their names
 * @property {boolean} apart whether each painting is a job
 */

const STORED = "sgsst.draft";
/** @type {Draft | null} */
let kept = null;

/** @param {Draft} draft */
export function keepDraft(draft) {
  kept = draft;
  const parts = (/** @type {boolean} */ stored) => Object.entries(draft.files).map(([role, all]) => /** @type {const} */ ([role, all.filter((file) => file instanceof StoredFile === stored)]));
  const files = Object.fromEntries(parts(true)), lost = Object.fromEntries(parts(false).map(([role, all]) => [role, [...all.map(({ name }) => name), ...(draft.lost?.[role] ?? [])]]));
  const regions = draft.regions.map(({ mask, select, ...region }) => ({ ...region, ...(mask && !(mask.file instanceof StoredFile) ? {} : { select }) }));
  try {
    sessionStorage.setItem(STORED, JSON.stringify({ ...draft, files, lost, regions }));
  } catch {
    // private windows may have no storage
  }
}

/** @returns {Draft | null} */
export function keptDraft() {
  if (kept) return kept;
  try {
    const draft = JSON.parse(sessionStorage.getItem(STORED) ?? "null");
    for (const files of Object.values(draft?.files ?? {})) files.forEach((/** @type {any} */ file, /** @type {number} */ i) => (files[i] = new StoredFile(file.path, file)));
    return draft;
  } catch {
    return null;
  }
}

/** Forget everything that was entered into the form. */
export function forgetDraft() {
  kept = null;
  sessionStorage.removeItem(STORED);
}

/**
 * Open the form with the inputs and parameters of a job, which replace what was entered before. Inputs that the service
 * has deleted are asked for again.
 *
 * @param {any} job
 * @param {{painting?: boolean}} [how] `painting`: whether to keep the job's paintings; those of regions are kept anyway
 */
export async function startFrom(job, { painting = true } = {}) {
  const { style_weights: weights, regions, orbit, preset, name: _, ...others } = job.parameters, inputs = await allInputs(job);
  const taken = new Set((regions ?? []).flatMap(paintingsOf)), own = inputs.style.filter(({ name }) => !taken.has(name));
  if (!painting) inputs.style = inputs.style.filter((file) => !own.includes(file));
  const values = Object.fromEntries(Object.entries({ ...others, orbit: orbit && (others.views ?? orbit) }).filter(([, value]) => value !== null));
  if (values.content_weight !== undefined) values.content_weight = strengthName(values.content_weight);
  for (const color of ["background", "style_background"]) if (Array.isArray(values[color])) values[color] = values[color].map((/** @type {number} */ part) => Math.round(255 * part));
  const gone = job.status === "expired", nothing = { scene: [], style: [], cameras: [], photos: [] };
  keepDraft({
    values, preset, orbiting: orbit !== null && orbit !== undefined, regions: regions ?? [], apart: false, again: true,
    files: gone ? nothing : inputs, expired: gone ? Object.fromEntries(Object.entries(inputs).map(([role, all]) => [role, all.map(({ name }) => name)])) : {},
    weights: Object.fromEntries(weights ? own.map(({ name }, i) => [name, String(weights[i])]) : []),
  });
  location.hash = "#/";
}
