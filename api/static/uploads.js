// @ts-check
/** Uploads in parts (tus 1.0). What has arrived is not sent again after a stop, a lost connection or a reload. */
import { ask, Problem, Unreachable } from "./api.js";
import { words } from "./words.js";

const TUS = { "Tus-Resumable": "1.0.0" };
const KEPT = "sgsst.uploads", MOST_KEPT = 60;
const SMALLEST = 1 << 20, LARGEST = 1 << 26;
/** Milliseconds between attempts while there is no connection. */
const AGAIN = 1000;
/** Target duration of a part in milliseconds. */
const PART = 1500;
const SAMPLES = 64, SAMPLE = 4096;

/** @typedef {"waiting" | "sending" | "offline" | "done"} State */
/** @typedef {{id: string, name: string, size: number, sent: number}} Kept */

/** @typedef {"localStorage" | "sessionStorage"} Place `sessionStorage` is that of this tab */

/** Return a stored value; null if there is none, or if the browser stores nothing. @param {Place} place @param {string} name */
export function stored(place, name) {
  try {
    return JSON.parse(window[place].getItem(name) ?? "null");
  } catch {
    return null;
  }
}

/** Store a value, unless the browser stores nothing or has no space. @param {Place} place @param {string} name @param {any} value null to forget it */
export function store(place, name, value) {
  try {
    if (value === null) window[place].removeItem(name);
    else window[place].setItem(name, JSON.stringify(value));
  } catch {
    // what is stored is a convenience
  }
}

/** @returns {Record<string, Kept>} */
const kept = () => stored("localStorage", KEPT) ?? {};

/** @param {string} print @param {Kept | null} upload null to forget it */
function keep(print, upload) {
  const { [print]: _, ...others } = kept(), all = Object.entries(upload ? { ...others, [print]: upload } : others);
  store("localStorage", KEPT, Object.fromEntries(all.slice(-MOST_KEPT)));
}

/** Return uploads that were started and not finished, with the modification times of their files. */
export const unfinished = () => Object.entries(kept()).map(([print, upload]) => ({ ...upload, modified: Number(print.split("|").at(-3)) })).filter(({ sent, size }) => sent > 0 && sent < size);

/** Forget all unfinished uploads. */
export const forgetUnfinished = () => {
  for (const [print, { sent, size }] of Object.entries(kept())) if (sent < size) keep(print, null);
};

/** Return a fingerprint: name, size, modification time and hashes of samples of a file. @param {File} file */
export async function fingerprint(file) {
  const pieces = file.size <= SAMPLES * SAMPLE ? [file] : Array.from({ length: SAMPLES }, (_, i) => {
    const at = Math.floor(((file.size - SAMPLE) * i) / (SAMPLES - 1));
    return file.slice(at, at + SAMPLE);
  });
  let a = 0x811c9dc5, b = 0x1b873593;
  for (const piece of pieces) {
    for (const byte of new Uint8Array(await piece.arrayBuffer())) {
      a = Math.imul(a ^ byte, 0x01000193);
      b = Math.imul(b + byte, 0x85ebca6b) ^ (b >>> 13);
    }
  }
  return [file.name, file.size, file.lastModified, (a >>> 0).toString(16), (b >>> 0).toString(16)].join("|");
}

export class Upload {
  /** @param {File} file @param {() => void} told called after each change of the state */
  constructor(file, told) {
    this.file = file;
    this.told = told;
    this.sent = 0;
    /** @type {State} */
    this.state = "waiting";
    this.id = "";
    this.part = SMALLEST;
    /** @type {AbortController | null} */
    this.sending = null;
    this.over = false;
  }

  /** @param {State} state */
  enter(state) {
    this.state = state;
    this.told();
  }

  /** Stop the upload; parts that have arrived remain for a later attempt. */
  stop() {
    this.over = true;
    this.sending?.abort();
  }

  /** Send the missing parts. @throws {DOMException} if it was stopped */
  async run() {
    this.print = await fingerprint(this.file);
    this.id = kept()[this.print]?.id ?? this.id;
    while (!this.over) {
      try {
        await this.findOffset();
        while (this.sent < this.file.size && !this.over) await this.sendPart();
        if (!this.over) return this.enter("done");
      } catch (error) {
        if (!this.canGoOn(error)) throw error;
        this.enter("offline");
        await new Promise((done) => setTimeout(done, AGAIN));
      }
    }
    throw new DOMException("", "AbortError");
  }

  /** @param {unknown} error */
  canGoOn(error) {
    if (this.over) return false;
    if (error instanceof Unreachable) return true;
    if (!(error instanceof Problem)) return false;
    if (error.status === 404) this.forget();
    return [404, 408, 409, 423, 429, 460, 500, 502, 503, 504].includes(error.status);
  }

  forget() {
    if (this.print) keep(this.print, null);
    this.id = "";
    this.sent = 0;
  }

  /** Find the offset from which to resume, or create an upload if there is none. */
  async findOffset() {
    const { file } = this;
    if (this.id) {
      try {
        const answer = await ask("HEAD", `v1/uploads/${this.id}`, { headers: TUS });
        if (Number(answer.headers.get("Upload-Length")) !== file.size) throw new Problem(404, null);
        return this.arrived(Number(answer.headers.get("Upload-Offset")));
      } catch (error) {
        if (!(error instanceof Problem) || error.status !== 404) throw error;
        this.forget();
      }
    }
    const name = btoa(String.fromCharCode(...new TextEncoder().encode(file.name.slice(-180))));
    const headers = { ...TUS, "Upload-Length": String(file.size), "Upload-Metadata": `filename ${name}` };
    this.id = (await (await ask("POST", "v1/uploads", { headers })).json()).id;
    this.arrived(0);
  }

  /** @param {number} sent */
  arrived(sent) {
    this.sent = sent;
    if (this.print) keep(this.print, { id: this.id, name: this.file.name, size: this.file.size, sent });
    this.enter("sending");
  }

  async sendPart() {
    const begun = performance.now(), size = Math.min(this.part, this.file.size - this.sent);
    this.sending = new AbortController();
    const body = this.file.slice(this.sent, this.sent + size);
    const headers = { ...TUS, "Upload-Offset": String(this.sent), "Content-Type": "application/offset+octet-stream" };
    const answer = await ask("PATCH", `v1/uploads/${this.id}`, { body, headers, signal: this.sending.signal });
    this.arrived(Number(answer.headers.get("Upload-Offset")));
    const took = performance.now() - begun;
    this.part = Math.round(Math.min(LARGEST, Math.max(SMALLEST, (size * PART) / Math.max(took, 1), this.part / 2), this.part * 2));
  }
}

/** Send files, three of them concurrently. @param {Upload[]} uploads */
export async function sendAll(uploads) {
  const waiting = [...uploads];
  const work = async () => {
    for (let next = waiting.shift(); next; next = waiting.shift()) await next.run();
  };
  await Promise.all([work(), work(), work()]);
}

/** @param {Upload} upload */
export const uploadText = ({ state, sent, file }) => (state === "done" ? "" : words.uploads[state](sent / Math.max(file.size, 1)));
