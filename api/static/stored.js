// @ts-check
/** Inputs that the service has from an earlier job: a new job uses them without another upload. */
import { ask, get } from "./api.js";

/** @typedef {File | StoredFile} Chosen file of a form: on this device, or on the service */

export class StoredFile {
  /**
   * @param {string} path path of the input in the API, without the leading slash that a new job refers to it by
   * @param {{name: string, size: number, sha256: string}} input
   */
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

/**
 * Return the scene, styles and cameras of a job by role, in their order.
 *
 * @param {any} job
 * @returns {Record<string, StoredFile[]>}
 */
export function storedInputs(job) {
  /** @type {Record<string, StoredFile[]>} */
  const found = { scene: [], style: [], cameras: [], photos: [], mask: [] };
  for (const input of job.inputs) {
    const those = found[input.role];
    those?.push(new StoredFile(`v1/jobs/${job.id}/inputs/${input.role}:${those.length}`, input));
  }
  return found;
}

/**
 * Return the inputs of a job by role, with all photos and masks, whose names the job itself does not have.
 *
 * @param {any} job
 * @returns {Promise<Record<string, StoredFile[]>>}
 */
export async function allInputs(job) {
  if (!job.input_counts.photos && !job.input_counts.mask) return storedInputs(job);
  const inputs = [];
  for (let cursor = "0"; cursor !== null; ) {
    const page = await get(`v1/jobs/${job.id}/inputs?cursor=${cursor}`);
    inputs.push(...page.inputs);
    cursor = page.next_cursor;
  }
  return storedInputs({ id: job.id, inputs });
}

/** Return the content of a chosen file. @param {Chosen} file @returns {Promise<Blob>} */
export const contentOf = async (file) => (file instanceof StoredFile ? (await ask("GET", file.path)).blob() : file);
