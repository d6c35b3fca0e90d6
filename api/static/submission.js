// @ts-check
/** Requests of the form for a new job, which send the files and plan or create the job, and the card that shows them. */
import { ask, eventsOf, Problem, randomKey } from "./api.js";
import { h } from "./dom.js";
import { StoredFile } from "./stored.js";
import { sendAll, Upload, uploadText } from "./uploads.js";
import { words } from "./words.js";

/** @typedef {import("./stored.js").Chosen} Chosen */

const say = words.submit;

export class Submission {
  /** @param {AbortSignal} leaving aborted when the view ends */
  constructor(leaving) {
    this.leaving = leaving;
    this.stopped = false;
    /** Whether the service refuses a job whose up direction or cameras are doubtful. */
    this.sure = true;
    /** Uploads of all files that were sent. @type {Map<File, Upload>} */
    this.uploads = new Map();
    /** Uploads that are shown. @type {Upload[]} */
    this.sending = [];
    /** Idempotency keys of requests for jobs, by their bodies. @type {Map<string, string>} */
    this.keys = new Map();
    this.stopping = new AbortController();
    this.bar = h("progress", { max: 1, value: 0, "aria-label": words.uploads.title });
    this.text = h("span");
    this.stopButton = h("button.quiet.small", { type: "button", onclick: () => this.stop() }, words.submit.stop);
    this.title = h("strong", words.uploads.title);
    this.element = h("div.sending", { hidden: true }, h("div.row", this.title, this.text, this.stopButton), this.bar);
  }

  restart() {
    this.stopped = false;
    this.stopping = new AbortController();
  }

  /** Stop sending and planning; the form stays as it is. */
  stop() {
    this.stopped = true;
    this.stopping.abort();
    for (const upload of this.sending) upload.stop();
  }

  /** Upload what the service lacks; return all addresses by role. @param {Record<string, Chosen[]>} files */
  async send(files) {
    const all = /** @type {File[]} */ (Object.values(files).flat().filter((file) => !(file instanceof StoredFile)));
    for (const file of all) if (!this.uploads.has(file)) this.uploads.set(file, new Upload(file, () => this.show()));
    this.sending = all.map((file) => /** @type {Upload} */ (this.uploads.get(file)));
    for (const upload of this.sending) upload.over = false;
    this.show();
    await sendAll(this.sending);
    const named = (/** @type {Chosen[]} */ chosen) => chosen.map((file) => (file instanceof StoredFile ? `/${file.path}` : this.uploads.get(file)?.id));
    return Object.fromEntries(Object.entries(files).map(([role, chosen]) => [role, named(chosen)]));
  }

  /** Return a plan; undefined if `stopping` was aborted. @param {any} body @returns {Promise<any>} */
  async plan(body) {
    this.tell(say.planning);
    const signal = AbortSignal.any([this.leaving, this.stopping.signal]), headers = { Accept: "text/event-stream" };
    try {
      const answer = await ask("POST", "v1/jobs?dry_run=true", { json: body, headers, signal });
      if (!answer.headers.get("content-type")?.includes("event-stream")) return await answer.json();
      for await (const { event, data } of eventsOf(answer)) {
        if (event === "planning") this.tell(data.stage === "planning" ? say.planned(data.step, data.total) : words.job.stages[data.stage], data.total ? data.fraction : undefined);
        else if (event === "problem") throw new Problem(data.status, data);
        else if (event === "plan") return data;
      }
    } catch (error) {
      if (this.stopped || !this.stopping.signal.aborted) throw error;
    }
  }

  /** Create jobs, and return them. @param {any[]} bodies */
  async create(bodies) {
    this.tell(say.starting);
    this.stopButton.hidden = true; // the service may already have accepted the job
    /** @type {any[]} */
    const jobs = [];
    for (const body of bodies) {
      const text = JSON.stringify(body), key = this.keys.get(text) ?? randomKey();
      this.keys.set(text, key); // a second attempt creates only those jobs that are missing
      try {
        jobs.push(await (await ask("POST", `v1/jobs?sure_up=${this.sure}`, { json: body, headers: { "Idempotency-Key": key } })).json());
      } catch (error) {
        if (jobs.length && error instanceof Error) error.message += ` ${say.createdSome(jobs.length, bodies.length)}`;
        throw error;
      }
    }
    return jobs;
  }

  show() {
    const { sending } = this, total = sending.reduce((sum, { file }) => sum + file.size, 0), sent = sending.reduce((sum, upload) => sum + upload.sent, 0);
    const now = sending.find(({ state }) => state !== "done");
    this.bar.value = sent / Math.max(total, 1);
    this.text.textContent = now ? `${now.file.name}: ${uploadText(now)}` : "";
    this.title.hidden = !now;
    this.stopButton.hidden = false;
  }

  /** Show what the service does after all files were sent. @param {string} text @param {number} [share] */
  tell(text, share) {
    this.text.textContent = text;
    if (share !== undefined) this.bar.value = share;
    else this.bar.removeAttribute("value");
  }

  end() {
    for (const upload of this.uploads.values()) upload.stop();
  }
}
