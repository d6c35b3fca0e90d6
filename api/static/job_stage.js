// @ts-check
/** 3D view of a job: previews and its colors so far while it runs, then its result. */
import { artifactPath } from "./api.js";
import { h, put } from "./dom.js";
import { PaintPanel } from "./paint_panel.js";
import { LIVE, ResultStage } from "./result_stage.js";
import { Stage } from "./stage.js";
import { listenToDrops } from "./slots.js";
import { baseOf, keepBase, storedInputs, storedResult } from "./stored.js";
import { upName } from "./upright.js";
import { words } from "./words.js";

const say = words.job;
/** Statuses in which a job has its result, or its scene no longer. */
const GONE = new Set(["succeeded", "expired"]);

export class JobStage {
  /** @param {string} id @param {AbortSignal} leaving @param {Stage} [before] stage that has shown the job's scene */
  constructor(id, leaving, before) {
    this.id = id;
    this.leaving = leaving;
    this.title = "";
    this.picture = h("figure.preview");
    /** Stage that shows the scene until the job's files are known. @type {Stage | undefined} */
    this.first = before && new Stage(before);
    this.element = h("div.show", this.first?.element ?? this.picture);
    /** Name of the shown preview. */
    this.preview = "";
    /** Stage of the unfinished job. @type {ResultStage | undefined} */
    this.live = undefined;
    /** Function that opens a tab; it does nothing once the user has opened one. @type {(index: number) => void} */
    this.open = () => {};
    /** @type {ResultStage | undefined} */
    this.result = undefined;
    this.finishing = false;
    /** Id of the job that paints on the result. */
    this.next = "";
  }

  /** Give the 3D view to that of a job that paints on this one, or that this one paints on. @param {string} id */
  handOver(id) {
    const shown = this.result ?? this.live;
    return shown?.stage.viewer && (id === this.next || id === baseOf(this.id)) ? shown.handOver(id === this.next) : undefined;
  }

  /** @param {string} title title of the job */
  name(title) {
    this.title = title;
    for (const stage of [this.result, this.live]) if (stage) stage.stage.title = title;
  }

  /** Show a preview, unless a newer one or the result is shown. @param {string} name name of the artifact */
  showPreview(name) {
    if (this.result || (this.preview && name <= this.preview)) return;
    this.preview = name;
    const picture = h("img", { alt: say.preview, decoding: "async" });
    picture.onload = () => {
      if (this.preview !== name || this.result) return;
      put(this.picture, picture);
      if (!this.live?.live?.painted) this.open(1); // the first image precedes the first colors in 3D
    };
    picture.src = artifactPath(this.id, name);
  }

  /** Show a text while there is no preview. @param {string} text */
  showNoPreview(text) {
    if (!this.preview && !this.result) put(this.picture, h("p.quiet", text));
  }

  /** Show the scene of an unfinished job, then its colors. @param {any} job @param {Set<string>} names its files */
  showLive(job, names) {
    const ownScene = names.has("live/scene.ply"), painted = [LIVE, "colors.f16"].find((name) => names.has(name)) ?? "", { live: before } = this;
    if (this.result || this.finishing || GONE.has(job.status)) return;
    if (names.has("plan.json")) before?.standUp();
    if (before?.live?.ownScene === ownScene) return void (painted === LIVE && !before.live.painted && this.paint());
    const live = new ResultStage([job], { signal: this.leaving, live: { ownScene, painted }, stage: this.takeFirst() });
    if (!live.stage.viewer) return;
    before?.end();
    this.live = live;
    live.stage.title = this.title;
    this.open = this.showTabs([[say.threeD, h("div", live.element)], [say.preview, this.picture]]);
    if (names.has("plan.json")) live.standUp();
    live.loading.then(() => live.original || live !== this.live || put(this.element, this.picture)); // the browser cannot show it
  }

  /** Return the stage that shows the scene already, once. */
  takeFirst() {
    const { first } = this;
    this.first = undefined;
    return first;
  }

  /** Show the present colors of the unfinished job. */
  async paint() {
    const { live } = this, first = !live?.live?.painted;
    await live?.refresh();
    if (first && live?.live?.painted) this.open(0);
  }

  /** Show the result, where the running job was shown. @param {any} job @param {boolean} hasSheet before and after */
  async finish(job, hasSheet) {
    if (this.finishing) return;
    this.finishing = true;
    const { live } = this;
    this.live = undefined;
    await live?.loading;
    const kept = await live?.finish(job);
    if (!kept) live?.end();
    if (!this.leaving.aborted) this.showResult(job, hasSheet, kept ? live : undefined);
  }

  /** @param {any} job @param {boolean} hasSheet @param {ResultStage} [kept] stage that has shown the running job */
  showResult(job, hasSheet, kept) {
    this.result = kept ?? new ResultStage([job], { signal: this.leaving, stage: this.takeFirst() });
    this.result.stage.title = this.title;
    if (this.result.stage.viewer) this.offerPainting(this.result, job);
    const stage = h("div", this.result.element), sheet = h("figure.sheet", { hidden: true });
    /** @type {[string, HTMLElement][]} */
    const tabs = [[say.threeD, stage]];
    if (hasSheet) {
      if (this.result.stage.viewer) tabs.push([say.sheet, sheet]);
      else tabs.unshift([say.sheet, sheet]);
    }
    const fillSheet = () => put(sheet, h("a", { href: artifactPath(this.id, "before_after.jpg"), target: "_blank", rel: "noopener" }, h("img", { src: artifactPath(this.id, "before_after.jpg"), alt: say.sheetOf(this.title) })));
    this.showTabs(tabs, (body) => body === sheet && !sheet.firstChild && fillSheet());
  }

  /** @param {ResultStage} result @param {any} job */
  offerPainting(result, job) {
    const panel = new PaintPanel(result.stage, {
      side: () => result.own,
      files: async () => ({ scene: [await storedResult(job)], cameras: storedInputs(job).cameras }),
      parameters: () => ({ ...job.parameters, ...(job.parameters.orbit ? { up: upName(result.stage.up) } : {}) }),
      opened: (open) => {
        result.blend.element.disabled = open;
        if (!open) result.showSides();
      },
      created: ({ id }) => {
        keepBase(id, this.id);
        this.next = id;
        location.hash = `#/jobs/${id}`;
      },
    }, this.leaving);
    listenToDrops(([file]) => file && panel.use(file), this.leaving);
  }

  /**
   * @param {[string, HTMLElement][]} tabs titles and bodies; the first one is opened
   * @param {(body: HTMLElement) => void} [opened] called when a tab is opened
   * @returns {(index: number) => void} function that opens a tab
   */
  showTabs(tabs, opened = () => {}) {
    const inputs = tabs.map((_, i) => h("input", { type: "radio", name: `tab${this.id}`, onchange: () => ((this.open = () => {}), open(i)) }));
    const open = (/** @type {number} */ at) => {
      inputs[at].checked = true;
      tabs.forEach(([, body], i) => (body.hidden = i !== at));
      opened(tabs[at][1]);
    };
    const picker = h("fieldset.segments", h("legend.away", say.view3d), tabs.map(([name], i) => h("label", inputs[i], h("span", name))));
    put(this.element, h("div.row.tabs", picker), tabs.map(([, body]) => body));
    open(0);
    return open;
  }

  end() {
    this.first?.end();
    this.live?.end();
    this.result?.end();
  }
}
