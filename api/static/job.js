// @ts-check
/** View of one job: progress, loss and plan while it runs, and the result in 3D afterwards. */
import { artifactPath, ask, get, Problem } from "./api.js";
import { LossChart } from "./chart.js";
import { deleteButton } from "./fields.js";
import { announce, h, messageOf, put } from "./dom.js";
import { baseOf, startFrom } from "./stored.js";
import { actionsOf, installed, statusTitles, UNFINISHED, WORKING } from "./tables.js";
import { downloadCard, factsCard, filesCard, JobName, JobProgress, outcomeOf, ShareCard, VideoCard } from "./job_cards.js";
import { JobStage } from "./job_stage.js";
import { nameOf } from "./names.js";
import { planOf } from "./plan.js";
import { LIVE, PREVIEW } from "./result_stage.js";
import { time, words } from "./words.js";

const say = words.job;
/** Milliseconds after which a lost stream is reopened by the page. */
const AGAIN = 3000;
/** Milliseconds between requests for changes that were made elsewhere, such as in another tab. */
const ELSEWHERE = 5000;

/** Reasons of an early end after which a job can be continued. */
const CONTINUABLE = ["within", "on-request"];

/** Open the view of the same job again, whose result is out of date. */
const reopen = () => void dispatchEvent(new HashChangeEvent("hashchange"));

/** @param {string} status */
export const badge = (status) => h(`span.badge.${status}${WORKING.has(status) ? ".working" : ""}`, statusTitles[status] ?? status);

export class JobView {
  /** @param {string} id @param {import("./stage.js").Stage} [before] stage of the view before, which has shown the job's scene */
  constructor(id, before) {
    this.id = id;
    this.title = words.page.jobs;
    this.leaving = new AbortController();
    /** @type {any} */
    this.job = null;
    this.chart = new LossChart();
    this.name = new JobName(id, (job) => this.use(job), (error) => this.tellError(error));
    this.stage = new JobStage(id, this.leaving.signal, before);
    /** Gives the 3D view to that of another job. */
    this.handOver = (/** @type {string} */ id) => this.stage.handOver(id);
    this.state = new JobProgress();
    this.badge = h("span");
    this.meta = h("p.meta");
    this.outcome = h("ul.warnings", { hidden: true });
    this.actions = h("div.row.actions-inline");
    this.connection = h("p.connection", { hidden: true, role: "status" }, say.lost);
    this.error = h("div.failure", { hidden: true, role: "alert" });
    this.plan = h("section.card", { hidden: true });
    this.planTitle = h("h2");
    this.download = h("section.card", { hidden: true });
    this.film = h("div", { hidden: true });
    /** @type {VideoCard | undefined} */
    this.video = undefined;
    this.sharing = h("div", { hidden: true });
    this.files = h("section.card", { hidden: true });
    this.deletion = h("p.deletion");
    this.facts = h("section.card");
    this.curve = h("section.card", h("h2", say.loss), this.chart.element);
    this.body = h("div.job", h("header.head", h("div", h("div.row", this.name.heading, this.name.control, this.badge), this.meta, this.outcome), this.actions),
      this.connection, this.error, h("div.split.watch", h("div.pinned.tall", this.stage.element, this.state.element), h("div.panel", this.download, this.film, this.sharing, this.curve, this.plan, this.files, this.facts, this.deletion)));
    this.element = h("div", h("p.quiet.pending", words.page.loading));
    this.begin();
  }

  async begin() {
    try {
      await this.refresh();
    } catch (error) {
      if (this.leaving.signal.aborted) return;
      if (error instanceof Problem && error.status === 404) return this.showDeleted();
      const retry = h("button.quiet", { type: "button", onclick: () => this.begin() }, words.page.retry);
      return void put(this.element, h("div.empty", h("h1", words.page.error), h("p", error instanceof Error ? error.message : ""), retry));
    }
    put(this.element, this.body);
    await Promise.all([this.loadHistory(), this.loadFiles()]);
    if (this.leaving.signal.aborted) return;
    if (UNFINISHED.has(this.job.status)) this.watch();
    const timer = setInterval(() => document.hidden || this.lookElsewhere(), ELSEWHERE);
    this.leaving.signal.addEventListener("abort", () => clearInterval(timer));
    document.addEventListener("visibilitychange", () => document.hidden || this.lookElsewhere(), { signal: this.leaving.signal });
  }

  /** Show what has changed without an event: a new name, a retry, or the deletion of the job. */
  async lookElsewhere() {
    const { name, status } = this.job;
    try {
      const job = await get(`v1/jobs/${this.id}`, this.leaving.signal);
      if (job.name === name && job.status === status && status !== "queued") return; // its position changes without an event
      if (status === "succeeded" && UNFINISHED.has(job.status)) return reopen();
      this.use(job);
      if (UNFINISHED.has(job.status) && !UNFINISHED.has(status)) this.watch();
    } catch (error) {
      if (error instanceof Problem && error.status === 404 && !this.leaving.signal.aborted) this.showDeleted();
    }
  }

  showDeleted() {
    const text = this.job ? say.deleted : say.gone;
    this.leaving.abort();
    document.title = words.page.title(text);
    announce(text);
    put(this.element, h("div.empty", h("h1", text), h("a.button.quiet", { href: "#/jobs" }, words.page.jobs)));
  }

  async refresh() {
    this.use(await get(`v1/jobs/${this.id}`, this.leaving.signal));
  }

  async loadHistory() {
    try {
      this.chart.add((await get(`v1/jobs/${this.id}/progress`, this.leaving.signal)).points);
    } catch (error) {
      if (!(error instanceof Problem) || error.status !== 404) return;
    }
    this.curve.hidden = (this.paints || !UNFINISHED.has(this.job.status)) && !this.chart.points.size;
  }

  /** Watch the events of the job. The browser reconnects by itself, and sends the id of the last event. */
  watch() {
    if (this.leaving.signal.aborted) return;
    const source = (this.source = new EventSource(`v1/jobs/${this.id}/events`));
    this.leaving.signal.addEventListener("abort", () => source.close());
    source.onopen = () => this.setConnected(true);
    source.onerror = () => {
      if (this.leaving.signal.aborted) return;
      this.setConnected(!UNFINISHED.has(this.job.status));
      if (source.readyState === EventSource.CLOSED && UNFINISHED.has(this.job.status)) setTimeout(() => this.watchAgain(), AGAIN);
    };
    source.addEventListener("progress", (event) => this.onProgress(JSON.parse(event.data)));
    source.addEventListener("artifact", (event) => this.onArtifact(JSON.parse(event.data)));
    source.addEventListener("status", (event) => this.onStatus(JSON.parse(event.data)));
  }

  /** Reopen a stream that the server has refused; the browser does not retry those. */
  async watchAgain() {
    try {
      await this.refresh();
      this.setConnected(true);
      if (UNFINISHED.has(this.job.status)) this.watch();
      else await this.loadFiles();
    } catch {
      if (!this.leaving.signal.aborted) setTimeout(() => this.watchAgain(), AGAIN);
    }
  }

  /** @param {boolean} connected */
  setConnected(connected) {
    if (!this.connection.hidden && connected) announce(say.back);
    this.connection.hidden = connected;
  }

  /** @param {any} progress */
  onProgress(progress) {
    this.chart.add([progress]);
    const known = this.job.progress?.updated_at;
    if (known && progress.updated_at < known) return; // already shown before a reload
    this.job.progress = progress;
    this.state.show(this.job);
  }

  /** @param {{name: string}} artifact */
  onArtifact({ name }) {
    if (name.startsWith(PREVIEW)) this.stage.showPreview(name);
    else if (name === LIVE && this.stage.live) this.stage.paint();
    else {
      clearTimeout(this.waiting);
      this.waiting = setTimeout(() => this.loadFiles(), 400);
    }
  }

  /** @param {{status: string}} told */
  async onStatus({ status }) {
    await this.refresh().catch(() => {});
    announce(statusTitles[status] ?? status);
    if (!UNFINISHED.has(this.job.status)) {
      this.source?.close();
      this.setConnected(true);
      await Promise.all([this.loadFiles(), this.loadHistory()]);
    }
  }

  /** Whether the job paints on a scene: it has neither a style nor a loss. @returns {boolean} */
  get paints() {
    return !!this.job.parameters.painted?.length;
  }

  /** @param {any} job */
  use(job) {
    this.job = job;
    this.title = nameOf(job);
    document.title = words.page.title(this.title);
    this.stage.name(this.title);
    this.name.show(job.name, this.title);
    put(this.badge, badge(job.status));
    this.planTitle.textContent = UNFINISHED.has(job.status) ? words.plan.decided : words.plan.ran;
    const took = job.started_at && job.finished_at ? (Date.parse(job.finished_at) - Date.parse(job.started_at)) / 1000 : 0;
    this.meta.textContent = [say.made(time(job.created_at)), took && say.took(took), job.result?.psnr_after && words.paint.fit(job.result.psnr_before, job.result.psnr_after), job.attempt > 1 && say.attempt(job.attempt), job.expires_at ? say.expires(time(job.expires_at)) : job.parameters.retention_days && say.kept(job.parameters.retention_days)].filter(Boolean).join(" · ");
    const outcome = job.status === "succeeded" ? outcomeOf(job.result) : "";
    this.outcome.hidden = !outcome;
    put(this.outcome, h("li", outcome));
    if (UNFINISHED.has(job.status)) this.curve.hidden = this.paints;
    this.error.hidden = !job.error;
    if (job.error) put(this.error, h("strong", say.failed), h("p", job.error.message));
    this.showActions();
    this.state.show(job);
    put(this.facts, factsCard(job));
  }

  showActions() {
    const { job } = this;
    const button = (/** @type {string} */ name, /** @type {() => any} */ act, kind = "quiet") => h(`button.${kind}`, { type: "button", onclick: () => this.act(act) }, name);
    if (this.shownFor === job.status) return;
    this.shownFor = job.status;
    const offered = actionsOf(job.status).filter(({ name }) => (job.status !== "succeeded" || CONTINUABLE.includes(job.result?.stopped)) && !(this.paints && name === "finish"));
    const titleOf = (/** @type {{name: string, title: string}} */ { name, title }) => (name === "retry" && (job.result || job.progress?.step) ? say.goOn : say.actions[name] ?? title);
    const base = baseOf(this.id), start = (/** @type {string} */ name, how = {}) => h("button.quiet", { type: "button", onclick: () => startFrom(this.job, how) }, name);
    put(this.actions, base && h("a.button.quiet", { href: `#/jobs/${base}` }, words.paint.undoAll),
      offered.map((action) => button(titleOf(action), () => ask("POST", `v1/jobs/${this.id}/${action.name}`), UNFINISHED.has(job.status) ? "quiet" : "primary")),
      UNFINISHED.has(job.status) ? null : !this.paints ? [start(say.anotherPainting, { painting: false }), start(say.changed)] : job.status === "succeeded" ? start(words.paint.stylize) : null);
    put(this.deletion, UNFINISHED.has(job.status) ? null : deleteButton(say.remove, async () => {
        await ask("DELETE", `v1/jobs/${this.id}`);
        location.hash = "#/jobs";
      }, (error) => this.tellError(error)));
  }

  /** @param {() => any} act */
  async act(act) {
    try {
      await act();
      if (this.job.status === "succeeded") return reopen();
      await this.refresh();
      if (UNFINISHED.has(this.job.status) && this.source?.readyState !== EventSource.OPEN) this.watch();
    } catch (error) {
      this.tellError(error);
    }
  }

  /** @param {unknown} error */
  tellError(error) {
    this.error.hidden = false;
    put(this.error, h("p", messageOf(error)));
  }

  async loadFiles() {
    /** @type {any[]} */
    let found;
    try {
      found = (await get(`v1/jobs/${this.id}/artifacts`, this.leaving.signal)).artifacts;
    } catch {
      return;
    }
    const names = new Set(found.map(({ name }) => name)), preview = [...names].filter((name) => name.startsWith(PREVIEW)).sort().at(-1);
    if (preview) this.stage.showPreview(preview);
    else this.stage.showNoPreview(UNFINISHED.has(this.job.status) ? say.noPreview : "");
    this.files.hidden = false;
    put(this.files, filesCard(this.id, found.filter(({ name }) => !/^(previews|live)\//.test(name))));
    if (names.has("plan.json") && this.plan.hidden) {
      const plan = await get(artifactPath(this.id, "plan.json"), this.leaving.signal).catch(() => null); // the job is shown without it
      this.plan.hidden = !plan;
      put(this.plan, planOf(this.planTitle, plan?.decisions ?? []));
    }
    const result = found.find(({ name }) => name === "stylized.ply"), video = found.find(({ name }) => name === "video.mp4");
    this.stage.showLive(this.job, names);
    if (this.job.status !== "succeeded" || !result) return;
    if (!this.video && (installed.video || video)) {
      this.video = new VideoCard(this.job, this.leaving.signal);
      put(this.film, this.video.element);
      this.film.hidden = false;
    }
    if (video) this.video?.play(video);
    if (this.stage.finishing) return;
    this.download.hidden = this.sharing.hidden = false;
    put(this.download, downloadCard(this.id, result.size));
    put(this.sharing, new ShareCard(this.id).element);
    await this.stage.finish(this.job, names.has("before_after.jpg"));
  }

  end() {
    this.leaving.abort();
    clearTimeout(this.waiting);
    this.chart.end();
    this.stage.end();
  }
}
