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
    this.card = new SendingCard(() => this.stop());
    /** Idempotency keys of requests for jobs, by their bodies. @type {Map<string, string>} */
    this.keys = new Map();
    this.stopping = new AbortController();
  }

  /** Prepare for another request. */
  restart() {
    this.stopped = false;
    this.stopping = new AbortController();
  }

  /** Stop planning, or don't start it. */
  stopPlanning() {
    this.stopping.abort();
  }

  /** Stop sending and planning; the form stays as it is. */
  stop() {
    this.stopped = true;
    this.stopPlanning();
    this.card.stop();
  }

  /**
   * Upload the files that the service lacks, and return the addresses of all files by role, for a job's body.
   *
   * @param {Record<string, Chosen[]>} files
   */
  async send(files) {
    const all = /** @type {File[]} */ (Object.values(files).flat().filter((file) => !(file instanceof StoredFile)));
    const ids = await this.card.send(all), idOf = new Map(all.map((file, i) => [/** @type {Chosen} */ (file), ids[i]]));
    const named = (/** @type {Chosen[]} */ chosen) => chosen.map((file) => (file instanceof StoredFile ? `/${file.path}` : idOf.get(file)));
    return Object.fromEntries(Object.entries(files).map(([role, chosen]) => [role, named(chosen)]));
  }

  /**
   * Return the plan of a job.
   *
   * @param {any} body
   * @returns {Promise<any>} undefined if the service did not send one, or if `stopPlanning` was called
   */
  async plan(body) {
    try {
      return await this.readPlan(body);
    } catch (error) {
      if (this.stopped || !this.stopping.signal.aborted) throw error;
    }
  }

  /** @param {any} body @returns {Promise<any>} */
  async readPlan(body) {
    this.card.tell(say.planning);
    const answer = await ask("POST", "v1/jobs?dry_run=true", { json: body, headers: { Accept: "text/event-stream" }, signal: AbortSignal.any([this.leaving, this.stopping.signal]) });
    if (!answer.headers.get("content-type")?.includes("event-stream")) return answer.json();
    for await (const { event, data } of eventsOf(answer)) {
      if (event === "planning") this.card.tell(data.stage === "planning" ? say.planned(data.step, data.total) : words.job.stages[data.stage], data.total ? data.fraction : undefined);
      else if (event === "problem") throw new Problem(data.status, data);
      else if (event === "plan") return data;
    }
  }

  /** Create jobs, and return them. @param {any[]} bodies */
  async create(bodies) {
    this.card.tell(say.starting);
    this.card.stopButton.hidden = true; // the service may already have accepted the job
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

  end() {
    this.card.end();
  }
}

export class SendingCard {
  /** @param {() => void} stop called when the user stops the request */
  constructor(stop) {
    /** Uploads of all files that were sent. @type {Map<File, Upload>} */
    this.uploads = new Map();
    /** Uploads that the card shows. @type {Upload[]} */
    this.sending = [];
    this.bar = h("progress", { max: 1, value: 0, "aria-label": words.uploads.title });
    this.text = h("span");
    this.pauseButton = h("button.quiet.small", { type: "button", onclick: () => this.pause() }, words.uploads.pause);
    this.stopButton = h("button.quiet.small", { type: "button", onclick: stop }, words.submit.stop);
    this.title = h("strong", words.uploads.title);
    this.element = h("div.sending", { hidden: true }, h("div.row", this.title, this.text, this.pauseButton, this.stopButton), this.bar);
  }

  /** Send files, and return the ids of their uploads. @param {File[]} files */
  async send(files) {
    for (const file of files) if (!this.uploads.has(file)) this.uploads.set(file, new Upload(file, () => this.show()));
    this.sending = files.map((file) => /** @type {Upload} */ (this.uploads.get(file)));
    for (const upload of this.sending) upload.over = false;
    this.show();
    return sendAll(this.sending);
  }

  show() {
    const { sending } = this, total = sending.reduce((sum, { file }) => sum + file.size, 0), sent = sending.reduce((sum, upload) => sum + upload.sent, 0);
    const now = sending.find(({ state }) => state !== "done");
    this.bar.value = sent / Math.max(total, 1);
    this.text.textContent = now ? `${now.file.name}: ${uploadText(now)}` : "";
    this.pauseButton.hidden = this.title.hidden = !now;
    this.stopButton.hidden = false;
    this.pauseButton.textContent = now?.state === "paused" ? words.uploads.resume : words.uploads.pause;
  }

  /** Show what the service does after all files were sent. @param {string} text @param {number} [share] */
  tell(text, share) {
    this.text.textContent = text;
    if (share !== undefined) this.bar.value = share;
    else this.bar.removeAttribute("value");
  }

  pause() {
    const paused = this.sending.some(({ state }) => state === "paused");
    for (const upload of this.sending) {
      if (paused) upload.resume();
      else upload.pause();
    }
  }

  stop() {
    for (const upload of this.sending) upload.stop();
  }

  end() {
    for (const upload of this.uploads.values()) upload.stop();
  }
}
