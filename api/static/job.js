// @ts-check
/** View of one job: progress, loss and plan while it runs, and the result in 3D afterwards. */
import { artifactPath, ask, get, Problem } from "./api.js";
import { LossChart } from "./chart.js";
import { announce, h, icon, put } from "./dom.js";
import { startFrom } from "./draft.js";
import { installed } from "./installed.js";
import { labels, nameOf } from "./names.js";
import { planOf } from "./plan.js";
import { ResultStage } from "./result_stage.js";
import { ShareCard } from "./share_card.js";
import { titleOf, valueText } from "./options.js";
import { resultFormats } from "./scene_formats.js";
import { actionsOf, titles, UNFINISHED, WORKING } from "./statuses.js";
import { VideoCard } from "./video_card.js";
import { size, time, words } from "./words.js";

const say = words.job;
/** Milliseconds after which a lost stream is reopened by the page. */
const AGAIN = 3000;
/** Milliseconds between requests for changes that were made elsewhere, such as in another tab. */
const ELSEWHERE = 5000;

/** Stages before the steps. */
const PLANNING = new Set(["planning", "refining", "probing"]);

/** Describe how a job ended; empty if it made all steps and its loss fell. @param {any} result */
function outcomeOf(result) {
  const { stopped, steps, total, loss_before: before, loss_after: after } = result ?? {}, risen = after > before;
  const early = steps < total ? say.early[stopped] : undefined;
  if (!early) return risen ? say.risen : "";
  const made = [say.steps(steps, total), before > 0 && say.lossLeft(after / before)].filter(Boolean).join(", ");
  return `${early}: ${made}. ${say.onward[stopped] ?? (risen ? say.risen : "")}`.trim();
}

/** @param {string} status */
export const badge = (status) => h(`span.badge.${status}${WORKING.has(status) ? ".working" : ""}`, titles[status] ?? status);

export class JobView {
  /** @param {string} id */
  constructor(id) {
    this.id = id;
    this.title = words.page.jobs;
    this.leaving = new AbortController();
    /** @type {any} */
    this.job = null;
    this.chart = new LossChart();
    this.lastEvent = "";
    this.heading = h("h1.name", say.unnamed);
    this.renaming = h("span.renaming");
    this.badge = h("span");
    this.meta = h("p.meta");
    this.outcome = h("ul.warnings", { hidden: true });
    this.actions = h("div.row.actions-inline");
    this.stateText = h("span");
    this.leftText = h("span.left");
    this.bar = h("progress", { max: 1, value: 0, "aria-label": say.progress });
    this.state = h("div.state", h("div.row", this.stateText, this.leftText), this.bar);
    this.connection = h("p.connection", { hidden: true, role: "status" }, say.lost);
    this.error = h("div.failure", { hidden: true, role: "alert" });
    this.picture = h("figure.preview");
    this.show = h("div.show", this.picture);
    this.plan = h("section.card", { hidden: true });
    this.planTitle = h("h2");
    this.download = h("section.card", { hidden: true });
    this.film = h("div", { hidden: true });
    /** @type {VideoCard | undefined} */
    this.video = undefined;
    this.sharing = h("div", { hidden: true });
    this.files = h("section.card");
    this.deletion = h("p.deletion");
    this.facts = h("section.card");
    this.curve = h("section.card", h("h2", say.loss), this.chart.element);
    this.body = h("div.job", h("header.head", h("div", h("div.row", this.heading, this.renaming, this.badge), this.meta, this.outcome), this.actions),
      this.connection, this.error, h("div.split.watch", h("div.pinned.tall", this.show, this.state), h("div.panel", this.download, this.film, this.sharing, this.curve, this.plan, this.files, this.facts, this.deletion)));
    this.element = h("div", h("p.quiet.pending", words.page.loading));
    this.begin();
  }

  async begin() {
    try {
      await this.refresh();
    } catch (error) {
      if (this.leaving.signal.aborted) return;
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
      if (job.name === name && job.status === status) return;
      this.job = job;
      this.update();
      if (UNFINISHED.has(job.status) && !UNFINISHED.has(status)) this.watch();
    } catch (error) {
      if (error instanceof Problem && error.status === 404 && !this.leaving.signal.aborted) this.showDeleted();
    }
  }

  showDeleted() {
    this.leaving.abort();
    document.title = words.page.title(say.deleted);
    announce(say.deleted);
    put(this.element, h("div.empty", h("h1", say.deleted), h("a.button.quiet", { href: "#/jobs" }, words.page.jobs)));
  }

  async refresh() {
    this.job = await get(`v1/jobs/${this.id}`, this.leaving.signal);
    this.update();
  }

  async loadHistory() {
    try {
      this.chart.add((await get(`v1/jobs/${this.id}/progress`, this.leaving.signal)).points);
    } catch (error) {
      if (!(error instanceof Problem) || error.status !== 404) return;
    }
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
    this.updateState();
  }

  /** @param {{name: string}} artifact */
  onArtifact({ name }) {
    if (name.startsWith("previews/")) this.showPreview(name);
    else if (name.startsWith("live/") && this.live) this.live.refresh();
    else this.filesLater();
  }

  filesLater() {
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => this.loadFiles(), 400);
  }

  /** @param {{status: string}} told */
  async onStatus({ status }) {
    await this.refresh().catch(() => {});
    announce(titles[status] ?? status);
    if (!UNFINISHED.has(this.job.status)) {
      this.source?.close();
      this.setConnected(true);
      await Promise.all([this.loadFiles(), this.loadHistory()]);
    }
  }

  update() {
    const { job } = this;
    this.title = nameOf(job);
    document.title = words.page.title(this.title);
    for (const stage of [this.result, this.live]) if (stage) stage.stage.title = this.title;
    this.heading.textContent = this.title;
    put(this.badge, badge(job.status));
    this.planTitle.textContent = UNFINISHED.has(job.status) ? words.plan.decided : words.plan.ran;
    const took = job.started_at && job.finished_at ? (Date.parse(job.finished_at) - Date.parse(job.started_at)) / 1000 : 0;
    this.meta.textContent = [say.made(time(job.created_at)), took && say.took(took), job.attempt > 1 && say.attempt(job.attempt), job.expires_at && say.expires(time(job.expires_at))].filter(Boolean).join(" · ");
    const outcome = job.status === "succeeded" ? outcomeOf(job.result) : "";
    this.outcome.hidden = !outcome;
    put(this.outcome, h("li", outcome));
    this.error.hidden = !job.error;
    if (job.error) put(this.error, h("strong", say.failed), h("p", job.error.message));
    this.showActions();
    this.updateState();
    this.showFacts();
    if (!this.renaming.firstChild) this.offerRename();
  }

  offerRename() {
    this.heading.hidden = false;
    put(this.renaming, h("button.tool", { type: "button", title: say.rename, "aria-label": say.rename, onclick: () => this.rename() }, icon("pen")));
  }

  /** Replace the heading by an input. Enter saves the name, Escape discards it. */
  rename() {
    const input = h("input", { type: "text", value: this.job.name, maxLength: 200, "aria-label": say.newName, autocomplete: "off" });
    const close = () => {
      this.offerRename();
      this.renaming.firstChild.focus();
    };
    input.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => event.key === "Escape" && close());
    const save = async (/** @type {Event} */ event) => {
      event.preventDefault();
      try {
        this.job = await (await ask("PATCH", `v1/jobs/${this.id}`, { json: { name: input.value.trim() } })).json();
        close();
        this.update();
      } catch (error) {
        this.tellError(error);
      }
    };
    this.heading.hidden = true;
    put(this.renaming, h("form", { onsubmit: save }, input, h("button.primary.small", { type: "submit" }, say.save), h("button.quiet.small", { type: "button", onclick: close }, say.keep)));
    input.focus();
    input.select();
  }

  updateState() {
    const { job } = this, running = UNFINISHED.has(job.status), { progress } = job;
    this.state.hidden = !running;
    if (!running) return;
    if (job.status === "queued" || !progress) {
      this.stateText.textContent = job.status !== "queued" ? titles[job.status] : job.queue_position === 1 ? say.next : job.queue_position ? say.queue(job.queue_position) : titles.queued;
      this.leftText.textContent = "";
      this.bar.removeAttribute("value");
      return;
    }
    const { stage, eta_s } = progress, planning = PLANNING.has(stage), checking = stage === "measuring";
    const [done, total] = checking ? [progress.views_checked ?? 0, progress.views_to_check ?? 0] : [progress.step, progress.total];
    this.stateText.textContent = [say.stages[stage] ?? stage, total ? (stage === "video" ? say.frame : planning || checking ? say.view : say.step)(done, total) : ""].filter(Boolean).join(" · ");
    // before the first step, the time of the steps is unknown
    this.leftText.textContent = eta_s === null || eta_s === undefined || planning ? "" : say.left(eta_s);
    if (total) this.bar.value = done / total;
    else this.bar.removeAttribute("value");
  }

  showActions() {
    const { job } = this;
    const button = (/** @type {string} */ name, /** @type {() => any} */ act, kind = "quiet") => h(`button.${kind}`, { type: "button", onclick: () => this.act(act) }, name);
    if (this.shownFor === job.status) return;
    this.shownFor = job.status;
    put(this.actions,
      actionsOf(job.status).map(({ name, title }) => button(say.actions[name] ?? title, () => ask("POST", `v1/jobs/${this.id}/${name}`), UNFINISHED.has(job.status) ? "quiet" : "primary")),
      UNFINISHED.has(job.status) ? null : [h("button.quiet", { type: "button", onclick: () => startFrom(this.job, { painting: false }) }, say.anotherPainting), h("button.quiet", { type: "button", onclick: () => startFrom(this.job) }, say.changed)]);
    put(this.deletion, UNFINISHED.has(job.status) ? null : deleteButton(say.remove, async () => {
        await ask("DELETE", `v1/jobs/${this.id}`);
        location.hash = "#/jobs";
      }, (error) => this.tellError(error)));
  }

  /** @param {() => any} act */
  async act(act) {
    try {
      await act();
      await this.refresh();
      if (UNFINISHED.has(this.job.status) && this.source?.readyState !== EventSource.OPEN) this.watch();
    } catch (error) {
      this.tellError(error);
    }
  }

  /** @param {unknown} error */
  tellError(error) {
    this.error.hidden = false;
    put(this.error, h("p", error instanceof Error ? error.message : String(error)));
  }

  /** @param {string} name name of a preview */
  showPreview(name) {
    if (this.result || (this.preview && name <= this.preview)) return;
    this.preview = name;
    const picture = h("img", { alt: say.preview, decoding: "async" });
    picture.onload = () => {
      if (this.preview === name && !this.result) put(this.picture, picture);
    };
    picture.src = artifactPath(this.id, name);
  }

  async loadFiles() {
    /** @type {any[]} */
    let found;
    try {
      found = (await get(`v1/jobs/${this.id}/artifacts`, this.leaving.signal)).artifacts;
    } catch {
      return;
    }
    const names = new Set(found.map(({ name }) => name));
    const previews = found.map(({ name }) => name).filter((name) => name.startsWith("previews/")).sort();
    if (previews.length) this.showPreview(previews[previews.length - 1]);
    else if (!this.preview && !this.result) put(this.picture, h("p.quiet", UNFINISHED.has(this.job.status) ? say.noPreview : ""));
    this.showFiles(found.filter(({ name }) => !/^(previews|live)\//.test(name)), names);
    if (names.has("plan.json") && this.plan.hidden) await this.loadPlan();
    const result = found.find(({ name }) => name === "stylized.ply"), video = found.find(({ name }) => name === "video.mp4");
    if (names.has("live/colors.f16")) this.showLive(names);
    if (this.job.status === "succeeded" && result && (installed.video || video)) this.offerVideo(video);
    if (this.job.status !== "succeeded" || !result || this.result || this.finishing) return;
    this.finishing = true;
    this.offerDownload(result.size);
    this.sharing.hidden = false;
    put(this.sharing, new ShareCard(this.id).element);
    const { live } = this;
    this.live = undefined;
    await live?.loading;
    const kept = await live?.finish(this.job);
    if (!kept) live?.end();
    if (!this.leaving.signal.aborted) this.showResult(names, kept ? live : undefined);
  }

  /** Show the scene with its colors so far. @param {Set<string>} names names of artifacts */
  showLive(names) {
    if (this.live || this.result || this.job.status === "succeeded") return;
    const live = new ResultStage([this.job], { signal: this.leaving.signal, live: { ownScene: names.has("live/scene.ply") } });
    if (!live.stage.viewer) return;
    this.live = live;
    live.stage.title = this.title;
    const open = this.showTabs([[say.threeD, live.element], [say.preview, this.picture]]);
    live.loading.then(() => live.original || open(1)); // this format cannot be shown in a browser
  }

  /** @param {any} video artifact; undefined if there is none yet */
  offerVideo(video) {
    this.video ??= new VideoCard(this.job, this.leaving.signal);
    if (!this.film.firstChild) put(this.film, this.video.element);
    this.film.hidden = false;
    if (video) this.video.play(video);
  }

  /** @param {number} bytes size of the PLY */
  offerDownload(bytes) {
    const link = h("a.button.primary", { download: "" }, icon("down"), h("span", say.download)), note = h("p.help");
    const chooser = h("select", { "aria-label": say.format, onchange: () => choose() },
      resultFormats.map(({ name, title }, i) => h("option", { value: name }, i ? title : `${title} · ${size(bytes)}`)));
    const choose = () => {
      const path = artifactPath(this.id, "stylized.ply"), first = chooser.value === resultFormats[0].name;
      link.href = first ? path : `${path}?format=${encodeURIComponent(chooser.value)}`;
      note.textContent = first ? "" : say.converting;
    };
    choose();
    this.download.hidden = false;
    put(this.download, h("h2", say.result), h("div.row.download", link, chooser), note);
  }

  async loadPlan() {
    try {
      const plan = await get(artifactPath(this.id, "plan.json"), this.leaving.signal);
      this.plan.hidden = false;
      put(this.plan, planOf(this.planTitle, plan.decisions ?? []));
    } catch {
      // the job is shown without its plan
    }
  }

  /**
   * @param {any[]} list
   * @param {Set<string>} names
   */
  showFiles(list, names) {
    put(this.files, h("h2", say.files), names.has("report.html") ? h("p", h("a.button.quiet", { href: artifactPath(this.id, "report.html"), target: "_blank", rel: "noopener" }, say.openReport)) : null,
      list.length ? h("ul.files", list.map(({ name, size: bytes }) => h("li", h("a", { href: artifactPath(this.id, name), download: name }, icon("down"), h("span", name)), h("small", size(bytes))))) : h("p.quiet", say.noFiles));
  }

  showFacts() {
    const { job } = this, told = Object.entries(job.parameters).filter(([name, value]) => value !== null && value !== "" && name !== "name" && value !== false);
    const files = Object.values(job.input_counts).reduce((sum, count) => sum + Number(count), 0);
    const fact = (/** @type {string} */ name, /** @type {string} */ value) => h("div", h("dt", name), h("dd", value));
    put(this.facts, h("h2", say.inputs), h("dl.facts", job.inputs.slice(0, 12).map((/** @type {any} */ input) => fact(input.role, `${input.name} · ${size(input.size)}`)), files > Math.min(job.inputs.length, 12) ? fact("", words.submit.nFiles(files)) : null),
      h("details.fold", h("summary", say.settings), h("dl.facts", told.map(([name, value]) => fact(titleOf(name), valueText(name, value))))));
  }

  /**
   * @param {Set<string>} names names of artifacts
   * @param {ResultStage} [kept] stage that has shown the job while it ran
   */
  showResult(names, kept) {
    this.result = kept ?? new ResultStage([this.job], { signal: this.leaving.signal });
    this.result.stage.title = this.title;
    const stage = h("div", this.result.element), sheet = h("figure.sheet", { hidden: true });
    /** @type {[string, HTMLElement][]} */
    const tabs = [[say.threeD, stage]];
    if (names.has("before_after.jpg")) {
      if (this.result.stage.viewer) tabs.push([say.sheet, sheet]);
      else tabs.unshift([say.sheet, sheet]);
    }
    const fillSheet = () => put(sheet, h("a", { href: artifactPath(this.id, "before_after.jpg"), target: "_blank", rel: "noopener" }, h("img", { src: artifactPath(this.id, "before_after.jpg"), alt: say.sheetOf(this.title) })));
    this.showTabs(tabs, (body) => body === sheet && !sheet.firstChild && fillSheet(), this.compareLink());
  }

  /**
   * @param {[string, HTMLElement][]} tabs titles and bodies; the first one is opened
   * @param {(body: HTMLElement) => void} [opened] called when a tab is opened
   * @param {HTMLElement} [beside] element beside the titles
   * @returns {(index: number) => void} function that opens a tab
   */
  showTabs(tabs, opened = () => {}, beside) {
    const inputs = tabs.map((_, i) => h("input", { type: "radio", name: `tab${this.id}`, onchange: () => open(i) }));
    const open = (/** @type {number} */ at) => {
      inputs[at].checked = true;
      tabs.forEach(([, body], i) => (body.hidden = i !== at));
      opened(tabs[at][1]);
    };
    const picker = h("fieldset.segments", h("legend.away", say.view3d), tabs.map(([name], i) => h("label", inputs[i], h("span", name))));
    put(this.show, h("div.row.tabs", picker, beside), tabs.map(([, body]) => body));
    open(0);
    return open;
  }

  /** Create a link to compare this job with other finished runs of the same scene. */
  compareLink() {
    const chooser = h("select", { "aria-label": say.compareWith, hidden: true, onchange: () => chooser.value && (location.hash = `#/compare/${this.id}/${chooser.value}`) });
    const scene = this.job.inputs.find((/** @type {any} */ input) => input.role === "scene")?.sha256;
    get("v1/jobs?status=succeeded&limit=100", this.leaving.signal).then(({ jobs }) => {
      const others = jobs.filter((/** @type {any} */ job) => job.id !== this.id && job.inputs.some((/** @type {any} */ input) => input.role === "scene" && input.sha256 === scene));
      chooser.hidden = !others.length;
      const names = labels(others);
      put(chooser, h("option", { value: "" }, `${say.compare}…`), others.map((/** @type {any} */ job, /** @type {number} */ i) => h("option", { value: job.id }, names[i])));
    }).catch(() => {});
    return chooser;
  }

  end() {
    this.leaving.abort();
    clearTimeout(this.waiting);
    this.chart.end();
    this.live?.end();
    this.result?.end();
  }
}

/**
 * Create a button that asks for confirmation.
 *
 * @param {string} name
 * @param {() => Promise<void>} act
 * @param {(error: unknown) => void} failed
 * @param {string} [label]
 */
export function deleteButton(name, act, failed, label) {
  const holder = h("span.sure");
  const first = h("button.quiet.danger", { type: "button", onclick: () => ask_(), "aria-label": label ?? name }, label ? icon("bin") : name);
  const ask_ = () => {
    const yes = h("button.danger", { type: "button", onclick: () => act().catch(failed) }, say.remove);
    holder.classList.add("asking");
    put(holder, h("span", say.removeSure), yes, h("button.quiet", { type: "button", onclick: () => (holder.classList.remove("asking"), put(holder, first), first.focus()) }, say.keep));
    yes.focus();
  };
  put(holder, first);
  return holder;
}

