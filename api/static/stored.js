// @ts-check
/** Content that a new job can reuse: inputs of earlier jobs, the draft of the form, and an interrupted upload. */
import { artifactPath, ask, get } from "./api.js";
import { h, put } from "./dom.js";
import { nameOf, paintingsOf } from "./names.js";
import { strengthName } from "./options.js";
import { forgetUnfinished, store, stored, unfinished } from "./uploads.js";
import { percent, size, words } from "./words.js";

/** @typedef {File | StoredFile} Chosen file of a form: on this device, or on the service */

export class StoredFile {
  /** @param {string} path in the API, no leading slash @param {{name: string, size: number, sha256: string}} input */
  constructor(path, { name, size, sha256 }) {
    this.path = path;
    this.name = name;
    this.size = size;
    this.sha256 = sha256;
  }

  /** Absolute address of the content. */
  get url() {
    return new URL(this.path, location.href).href;
  }
}

/** Return a job's inputs by role, in their order. @param {any} job @returns {Record<string, StoredFile[]>} */
export function storedInputs(job) {
  /** @type {Record<string, StoredFile[]>} */
  const found = { scene: [], style: [], cameras: [], photos: [], mask: [] };
  for (const input of job.inputs) {
    const those = found[input.role];
    those?.push(new StoredFile(`v1/jobs/${job.id}/inputs/${input.role}:${those.length}`, input));
  }
  return found;
}

/** Return all inputs by role; the job itself lacks the names of photos and masks. @param {any} job */
async function allInputs(job) {
  if (!job.input_counts.photos && !job.input_counts.mask) return storedInputs(job);
  const inputs = [];
  for (let cursor = "0"; cursor !== null; ) {
    const page = await get(`v1/jobs/${job.id}/inputs?cursor=${cursor}`);
    inputs.push(...page.inputs);
    cursor = page.next_cursor;
  }
  return storedInputs({ id: job.id, inputs });
}

/** Return the result of a job, as the scene of another one. @param {any} job */
export async function storedResult(job) {
  const name = "stylized.ply", { artifacts } = await get(`v1/jobs/${job.id}/artifacts`);
  return new StoredFile(artifactPath(job.id, name), { ...artifacts.find((/** @type {any} */ file) => file.name === name), name: `${nameOf(job)}.ply` });
}

/** Return the content of a chosen file. @param {Chosen} file @returns {Promise<Blob>} */
export const contentOf = async (file) => (file instanceof StoredFile ? (await ask("GET", file.path)).blob() : file);

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
  const parts = (/** @type {boolean} */ there) => Object.entries(draft.files).map(([role, all]) => /** @type {const} */ ([role, all.filter((file) => file instanceof StoredFile === there)]));
  const files = Object.fromEntries(parts(true)), lost = Object.fromEntries(parts(false).map(([role, all]) => [role, [...all.map(({ name }) => name), ...(draft.lost?.[role] ?? [])]]));
  const regions = draft.regions.map(({ mask, select, ...region }) => ({ ...region, ...(mask && !(mask.file instanceof StoredFile) ? {} : { select }) }));
  store("sessionStorage", STORED, { ...draft, files, lost, regions });
}

/** @returns {Draft | null} */
export function keptDraft() {
  if (kept) return kept;
  const draft = stored("sessionStorage", STORED), files = Object.entries(draft?.files ?? {});
  return draft && { ...draft, files: Object.fromEntries(files.map(([role, all]) => [role, all.map((/** @type {any} */ file) => new StoredFile(file.path, file))])) };
}

/** Forget everything that was entered into the form. */
export function forgetDraft() {
  kept = null;
  store("sessionStorage", STORED, null);
}

/**
 * Open the form with the inputs and parameters of a job, which replace what was entered before; the scene of a job that
 * has painted is its result. Inputs that the service has deleted are asked for again.
 *
 * @param {any} job
 * @param {{painting?: boolean}} [how] `painting`: whether to keep the job's paintings; those of regions are kept anyway
 */
export async function startFrom(job, { painting = true } = {}) {
  const { style_weights: weights, regions, orbit, preset, name: _, painted, ...others } = job.parameters, inputs = await allInputs(job);
  if (painted?.length) inputs.scene = [await storedResult(job)];
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

/** Start of the names under which this tab remembers the base of each job that paints. */
const BASE = "sgsst.base.";

/** Remember on whose result a job has painted. @param {string} id @param {string} base */
export const keepBase = (id, base) => store("sessionStorage", BASE + id, base);

/** Return the id of the job on whose result a job has painted, if this tab has created it. @param {string} id @returns {string | null} */
export const baseOf = (id) => stored("sessionStorage", BASE + id);

const say = words.submit;

export class UnfinishedNotice {
  /** @param {() => Chosen[]} chosen returns the files of the form */
  constructor(chosen) {
    this.chosen = chosen;
    this.element = h("div.notice", { hidden: true });
  }

  show() {
    const chosen = this.chosen().filter((file) => file instanceof File);
    const isOf = (/** @type {File} */ file, /** @type {any} */ { size, modified }) => file.size === size && file.lastModified === modified;
    const first = unfinished().find((upload) => chosen.every((file) => file.name !== upload.name || isOf(file, upload)));
    this.element.hidden = !first;
    if (!first) return;
    const again = chosen.some(({ name }) => name === first.name), share = percent(first.sent / first.size);
    put(this.element, h("p", again ? say.resumed(first.name, share) : say.resumable(first.name, size(first.size), share)),
      h("button.quiet", { type: "button", onclick: () => (forgetUnfinished(), this.show()) }, say.forget));
  }
}
