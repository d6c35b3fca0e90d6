// @ts-check
/** View that compares runs of one scene: their images side by side, and two of them on both sides of the wipe. */
import { artifactPath, get, Problem } from "./api.js";
import { h, put } from "./dom.js";
import { badge } from "./job.js";
import { labels } from "./names.js";
import { ResultStage } from "./result_stage.js";
import { stepFraction, UNFINISHED } from "./statuses.js";
import { percent, words } from "./words.js";

const say = words.compare;
/** Milliseconds between requests while a job runs. */
const OFTEN = 3000;

export class CompareView {
  /** @param {string[]} ids */
  constructor(ids) {
    this.ids = ids;
    this.title = say.title;
    this.leaving = new AbortController();
    this.heading = h("h1");
    this.sheet = h("ul.grid.contact", { "aria-label": say.sheet });
    this.holder = h("div");
    this.element = h("div.comparison", h("p.quiet.pending", words.page.loading));
    this.load();
  }

  async load() {
    try {
      const jobs = await Promise.all(this.ids.map((id) => get(`v1/jobs/${id}`, this.leaving.signal)));
      this.show(jobs);
      if (jobs.some((job) => UNFINISHED.has(job.status))) this.timer = setTimeout(() => (document.hidden ? this.later() : this.load()), OFTEN);
      else this.showStage(jobs.filter((job) => job.status === "succeeded"));
    } catch (error) {
      if (this.leaving.signal.aborted) return;
      put(this.element, h("div.empty", h("h1", error instanceof Problem && error.status === 404 ? words.job.gone : words.page.error), h("p", error instanceof Error && !(error instanceof Problem && error.status === 404) ? error.message : say.notThere), h("a.button.quiet", { href: "#/jobs" }, words.page.jobs)));
    }
  }

  later() {
    document.addEventListener("visibilitychange", () => this.load(), { once: true, signal: this.leaving.signal });
  }

  /** @param {any[]} jobs */
  show(jobs) {
    const names = labels(jobs);
    this.heading.textContent = names.length === 2 ? say.heading(names[0], names[1]) : say.several(names.length);
    if (this.heading.parentElement === null) put(this.element, h("header.head", this.heading), this.sheet, this.holder);
    const focused = [...this.sheet.querySelectorAll("a")].indexOf(/** @type {any} */ (document.activeElement));
    put(this.sheet, jobs.map((job, i) => tile(job, names[i])));
    if (focused >= 0) this.sheet.querySelectorAll("a")[focused]?.focus();
  }

  /** @param {any[]} jobs finished runs */
  showStage(jobs) {
    if (!jobs.length) throw new Error(say.notThere);
    this.stage = new ResultStage(jobs, { signal: this.leaving.signal });
    this.stage.stage.title = labels(jobs).join(" ");
    put(this.holder, this.stage.element);
  }

  end() {
    this.leaving.abort();
    clearTimeout(this.timer);
    this.stage?.end();
  }
}

/** Return the image of a job with its label and status. @param {any} job @param {string} name */
function tile(job, name) {
  const painted = stepFraction(job);
  const image = job.preview ? h("img", { src: artifactPath(job.id, job.preview), alt: words.job.sheetOf(name), decoding: "async" }) : h("span.blank", { "aria-hidden": "true" });
  return h("li.tile", h("a", { href: `#/jobs/${job.id}` }, h("div.thumbnail", image), h("strong", { title: name }, name)),
    h("div.row", badge(job.status), painted === undefined ? null : h("small", percent(painted))));
}
