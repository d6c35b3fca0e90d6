// @ts-check
/** Inputs that the service has from an earlier job: a new job uses them without another upload. */
import { ask } from "./api.js";

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
 * Return the inputs of a job by role, in their order.
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

/** Return the content of a chosen file. @param {Chosen} file @returns {Promise<Blob>} */
export const contentOf = async (file) => (file instanceof StoredFile ? (await ask("GET", file.path)).blob() : file);
