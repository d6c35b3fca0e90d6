// @ts-check
/** View of all jobs, and the one that compares runs of one scene: side by side, and two of them by the wipe. */
import { artifactPath, ask, get, Problem } from "./api.js";
import { announce, h, messageOf, put, tell } from "./dom.js";
import { deleteButton } from "./fields.js";
import { badge } from "./job.js";
import { labels, nameOf, stylesOf } from "./names.js";
import { ResultStage, sceneOf } from "./result_stage.js";
import { statusTitles, stepFraction, UNFINISHED } from "./tables.js";
import { percent, time, words } from "./words.js";

const say = words.jobs;
/** Milliseconds between polls while a job runs, and otherwise. */
const OFTEN = 3000, SELDOM = 5000;
const PAGE = 60;

export class JobsView {
  constructor() {
    this.title = say.title;
    this.leaving = new AbortController();
    /** @type {any[]} */
    this.jobs = [];
    /** @type {string | null} */
    this.cursor = null;
    /** @type {Set<string>} */
    this.chosen = new Set();
    /** @type {Map<string, {element: HTMLElement, told: string}>} */
    this.cards = new Map();
    this.name = h("input", { type: "search", "aria-label": say.filter, placeholder: say.filter, oninput: () => this.show() });
    this.status = h("select", { "aria-label": say.status, onchange: () => this.show() }, h("option", { value: "" }, say.any),
      Object.entries(statusTitles).map(([value, text]) => h("option", { value }, text)));
    this.compare = h("button.quiet", { type: "button", disabled: true, title: say.chooseTwo, onclick: () => this.compareChosen() }, say.compare);
    this.problem = h("p.wrong.block", { hidden: true, role: "alert" });
    this.list = h("ul.grid");
    this.more = h("button.quiet", { type: "button", hidden: true, onclick: () => this.load(true) }, say.more);
    this.body = h("div", h("header.head", h("h1", say.title), h("div.row", this.name, this.status, this.compare)), this.problem, this.list, h("p.center", this.more));
    this.element = h("div.jobs", h("p.quiet.pending", words.page.loading));
    this.load(false);
  }

  /** @param {boolean} more */
  async load(more) {
    clearTimeout(this.timer);
    try {
      const found = await get(`v1/jobs?limit=${PAGE}${more && this.cursor ? `&cursor=${this.cursor}` : ""}`, this.leaving.signal);
      const known = new Map(this.jobs.map((job) => [job.id, job]));
      for (const job of found.jobs) known.set(job.id, job);
      const newest = new Set(found.jobs.map((/** @type {any} */ job) => job.id)), last = found.jobs.at(-1)?.id ?? "";
      // a job that should be on this page of the list, but is not, was deleted
      this.jobs = [...known.values()].filter((job) => more || newest.has(job.id) || (found.next_cursor && job.id < last)).sort((a, b) => (a.id < b.id ? 1 : -1));
      if (more || !this.cursor) this.cursor = found.next_cursor;
      tell(this.problem, "");
      this.show();
    } catch (error) {
      if (this.leaving.signal.aborted) return;
      tell(this.problem, messageOf(error));
      put(this.element, this.body);
    }
    const running = this.jobs.some((job) => UNFINISHED.has(job.status));
    this.timer = later(() => this.load(false), running ? OFTEN : SELDOM, this.leaving.signal);
  }

  show() {
    if (!this.jobs.length && this.problem.hidden) {
      return void put(this.element, h("div.empty", h("h1", say.empty), h("p", say.emptyLead), h("a.button.primary", { href: "#/" }, words.page.toNew)));
    }
    if (this.body.parentElement !== this.element) put(this.element, this.body);
    const wanted = this.name.value.trim().toLowerCase(), status = this.status.value;
    const shown = this.jobs.filter((job) => (!status || job.status === status) && (!wanted || `${job.name} ${job.inputs.map((/** @type {any} */ input) => input.name).join(" ")}`.toLowerCase().includes(wanted)));
    const elements = shown.map((job) => this.card(job));
    if (!shown.length) elements.push(h("li.none", h("p.quiet", say.noMatch)));
    const before = [...this.list.children];
    if (before.length !== elements.length || before.some((each, i) => each !== elements[i])) put(this.list, elements);
    this.more.hidden = !this.cursor;
    this.compare.disabled = this.chosen.size < 2;
  }

  /** Return the card of a job; it is rebuilt only if the job has changed. @param {any} job */
  card(job) {
    const told = JSON.stringify([job.status, job.preview, stepFraction(job), job.queue_position, job.name]), known = this.cards.get(job.id);
    if (known?.told === told || known?.element.contains(document.activeElement)) return known.element;
    const name = nameOf(job), style = stylesOf(job);
    const running = UNFINISHED.has(job.status), done = job.status === "succeeded", painted = stepFraction(job);
    const early = done && job.result?.steps < job.result?.total;
    const choose = done ? h("label.check", h("input", { type: "checkbox", checked: this.chosen.has(job.id), "aria-label": say.select(name), onchange: (/** @type {any} */ event) => this.choose(job.id, event.target.checked) }), h("small", { "aria-hidden": "true" }, say.choose)) : null;
    const facts = [name.includes(style) ? "" : style, time(job.created_at), early && words.job.steps(job.result.steps, job.result.total)].filter(Boolean).join(" · ");
    const element = tile(job, name, { loading: "lazy" }, h("small", facts), [h("span.grow"), choose, running ? null : this.deleter(job, name)]);
    if (painted !== undefined) element.append(h("progress", { max: 1, value: painted, "aria-label": words.job.progress }));
    this.cards.set(job.id, { element, told });
    return element;
  }

  /** @param {any} job @param {string} name */
  deleter(job, name) {
    return deleteButton(words.job.remove, async () => {
      await ask("DELETE", `v1/jobs/${job.id}`);
      const at = [...this.list.children].findIndex((each) => each.contains(document.activeElement));
      this.jobs = this.jobs.filter((each) => each.id !== job.id);
      this.chosen.delete(job.id);
      announce(say.removed);
      this.show();
      const links = [...this.list.querySelectorAll("li > a")], next = links[Math.min(at, links.length - 1)] ?? this.element.querySelector("a");
      /** @type {HTMLElement | null} */ (next)?.focus();
    }, (error) => tell(this.problem, messageOf(error)), say.remove(name));
  }

  /** @param {string} id @param {boolean} on */
  choose(id, on) {
    this.chosen[on ? "add" : "delete"](id);
    this.compare.disabled = this.chosen.size < 2;
  }

  compareChosen() {
    const ids = [...this.chosen], scenes = new Set(ids.map((id) => sceneOf(this.jobs.find((job) => job.id === id))));
    if (scenes.size > 1) tell(this.problem, say.otherScenes);
    else location.hash = `#/compare/${ids.join("/")}`;
  }

  end() {
    this.leaving.abort();
    clearTimeout(this.timer);
  }
}

export class CompareView {
  /** @param {string[]} ids */
  constructor(ids) {
    this.ids = ids;
    this.title = words.compare.title;
    this.leaving = new AbortController();
    this.heading = h("h1");
    this.sheet = h("ul.grid.contact", { "aria-label": words.compare.sheet });
    this.holder = h("div");
    this.element = h("div.comparison", h("p.quiet.pending", words.page.loading));
    this.load();
  }

  async load() {
    try {
      const jobs = await Promise.all(this.ids.map((id) => get(`v1/jobs/${id}`, this.leaving.signal)));
      this.show(jobs);
      if (jobs.some((job) => UNFINISHED.has(job.status))) this.timer = later(() => this.load(), OFTEN, this.leaving.signal);
      else {
        const finished = jobs.filter((job) => job.status === "succeeded");
        if (!finished.length) throw new Error(words.compare.notThere);
        this.stage = new ResultStage(finished, { signal: this.leaving.signal });
        this.stage.stage.title = labels(finished).join(" ");
        put(this.holder, this.stage.element);
      }
    } catch (error) {
      if (this.leaving.signal.aborted) return;
      const gone = error instanceof Problem && error.status === 404;
      put(this.element, h("div.empty", h("h1", gone ? words.job.gone : words.page.error), h("p", gone ? words.compare.notThere : messageOf(error)), h("a.button.quiet", { href: "#/jobs" }, words.page.jobs)));
    }
  }

  /** @param {any[]} jobs */
  show(jobs) {
    const names = labels(jobs);
    this.heading.textContent = names.length === 2 ? words.compare.heading(names[0], names[1]) : words.compare.several(names.length);
    if (this.heading.parentElement === null) put(this.element, h("header.head", this.heading), this.sheet, this.holder);
    const focused = [...this.sheet.querySelectorAll("a")].indexOf(/** @type {any} */ (document.activeElement));
    put(this.sheet, jobs.map((job, i) => tile(job, names[i], { alt: words.job.sheetOf(names[i]) })));
    if (focused >= 0) this.sheet.querySelectorAll("a")[focused]?.focus();
  }

  end() {
    this.leaving.abort();
    clearTimeout(this.timer);
    this.stage?.end();
  }
}

/** Act after a time, but not while the page is hidden. @param {() => void} act @param {number} milliseconds @param {AbortSignal} signal */
function later(act, milliseconds, signal) {
  return setTimeout(() => (document.hidden ? document.addEventListener("visibilitychange", act, { once: true, signal }) : act()), milliseconds);
}

/** @param {any} job @param {string} name @param {any} how of the image @param {any} [facts] @param {any[]} [tools] */
function tile(job, name, how, facts = null, tools = []) {
  const painted = stepFraction(job);
  const image = job.preview ? h("img", { src: artifactPath(job.id, job.preview), alt: "", decoding: "async", ...how }) : h("span.blank", { "aria-hidden": "true" });
  return h("li.tile", h("a", { href: `#/jobs/${job.id}` }, h("div.thumbnail", image), h("strong", { title: name }, name), facts),
    h("div.row", badge(job.status), painted === undefined ? null : h("small", percent(painted)), tools));
}
