// @ts-check
/** Requests of the form for a new job: it sends the files, and then plans the job or creates it. */
import { ask, eventsOf, Problem, randomKey } from "./api.js";
import { SendingCard } from "./sending.js";
import { StoredFile } from "./stored.js";
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
