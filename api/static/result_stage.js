// @ts-check
/** Results of one scene in 3D: the original and each run's colors, or those so far, two on the sides of the wipe. */
import { artifactPath, ask, get, Problem } from "./api.js";
import { readCameras } from "./cameras.js";
import { Blend } from "./blend.js";
import { h, messageOf, put } from "./dom.js";
import { labels, nameOf, resultName } from "./names.js";
import { Stage } from "./stage.js";
import { directionOf, UPS } from "./upright.js";
import { requestedRendering } from "./viewer/render_tag.js";
import { ViewpointsPanel } from "./viewpoints.js";
import { words } from "./words.js";

/** @typedef {import("./viewer/viewer.js").Side} Side */
/** @typedef {{scene: string, result: (name: string) => string, cameras: () => Promise<{name: string, blob: Blob}[]>}} Files addresses */

const say = words.viewer;
/** Name of the file with the colors so far of a running job. */
export const LIVE = "live/colors.f16";
/** Start of the names of previews; the thumbnail of a finished job is none. */
export const PREVIEW = "previews/step_";

export class ResultStage {
  /**
   * @param {any[]} jobs finished runs; the scene is that of the first one
   * @param {{signal: AbortSignal, live?: {ownScene: boolean, painted: string}, files?: (job: any) => Files, blend?: boolean, stage?: Stage}} how
   *   `live`: the one run is unfinished; `ownScene`: the rows of its scene are not those of its input; `painted`: name
   *   of the file with its colors so far, or ""; `files`: where the files of a job are; `blend`: whether to offer
   *   blends; `stage`: stage that shows the scene already
   */
  constructor(jobs, { signal, live, files = (job) => filesOf(job, signal), blend = true, stage = new Stage() }) {
    this.jobs = jobs;
    this.files = files;
    this.signal = signal;
    this.live = live;
    /** @type {Promise<void>} */
    this.loading = Promise.resolve();
    /** @type {Promise<void> | undefined} */
    this.fetching = undefined;
    this.stage = stage;
    this.left = this.chooser(say.left);
    this.right = this.chooser(say.right);
    this.pickers = h("div.row.sides", { hidden: jobs.length < 2 || !this.stage.viewer }, this.left.element, this.right.element);
    this.blend = new Blend(jobs, jobs.length > 1 ? labels(jobs) : [nameOf(jobs[0])], () => this.showBlend());
    this.blend.element.hidden = true;
    /** Whether the up direction that the plan has found was read. */
    this.upright = false;
    this.blends = blend && jobs.length <= 2;
    this.viewpoints = new ViewpointsPanel(this.stage, jobs[0].viewpoints, jobs.length === 1 && blend && !live ? jobs[0].id : "");
    this.element = h("div.result-stage", this.pickers, this.stage.element, this.viewpoints.element, this.blend.element);
    /** Choices for each side of the wipe. @type {Map<string, {name: string, side: Side}>} */
    this.choices = new Map();
    if (jobs.length < 2 && jobs[0].parameters.painted?.length) this.stage.share ??= 0; // what was painted may be on either side of a wipe
    if (this.stage.viewer) {
      this.stage.viewer.onReload = () => (this.loading = this.load());
      this.loading = this.load();
    }
  }

  /** @param {string} name */
  chooser(name) {
    const select = h("select", { "aria-label": name, onchange: () => this.showSides(name) });
    return { select, element: h("label.option.inline", h("span", name), select) };
  }

  async load() {
    const { viewer } = this.stage, [first] = this.jobs;
    if (!viewer) return;
    for (const { side } of this.choices.values()) side.scene.worker.terminate(); // workers of a lost GPU context
    this.choices.clear();
    this.original = undefined;
    this.stage.original = null;
    viewer.background = first.parameters.background ?? [0, 0, 0];
    viewer.camera.near = first.parameters.near ?? 0.2;
    this.stage.message(words.page.loading);
    this.stage.up = directionOf(first.parameters.up) ?? this.stage.up;
    await Promise.all([this.loadCameras(), first.status === "succeeded" && this.standUp()]);
    this.stage.open();
    await this.openOriginal(first);
    for (const job of this.jobs) await this.openRun(job).catch((error) => this.tell(error));
    if (this.signal.aborted) return;
    this.offer();
  }

  async loadCameras() {
    try {
      const blobs = await this.files(this.jobs[0]).cameras();
      if (!blobs.length) return;
      this.stage.setCameras(await readCameras(blobs), { stand: !this.stage.viewer?.touched });
    } catch {
      // without cameras, the view is free
    }
  }

  /** Turn the scene to the up direction that the plan of an orbit has found. */
  async standUp() {
    const [job] = this.jobs, { orbit, up } = job.parameters;
    if (this.upright || !orbit || UPS[up]) return;
    this.upright = true;
    const plan = await get(this.files(job).result("plan.json"), this.signal).catch(() => null);
    const found = directionOf(plan?.decisions.find((/** @type {any} */ each) => each.item === "up")?.decision);
    if (found) this.stage.standUp(found);
  }

  /** @param {any} job */
  async openOriginal(job) {
    const { viewer } = this.stage;
    if (!viewer || this.signal.aborted) return;
    const files = this.files(job), own = this.live?.ownScene, path = own ? files.result("live/scene.ply") : files.scene;
    const shown = viewer.sides?.left, side = shown && !own ? shown : { scene: viewer.open(new URL(path, location.href).href), colors: "own" }, { scene } = side;
    if (side !== shown) shown?.scene.end();
    this.stage.show(side);
    try {
      const header = await scene.headerRead;
      header.rendering = requestedRendering(header.rendering, job.parameters);
      scene.ready.then(() => this.stage.open(), (error) => this.tell(error));
      this.original = scene;
      this.stage.original = side;
      this.blend.parts[0].colors = side.colors;
      this.choices.set("original", { name: say.original, side });
    } catch {
      scene.end(); // this format cannot be shown in a browser: only the result is
      viewer.sides = null;
    }
  }

  /** @param {any} job */
  async openRun(job) {
    const { viewer } = this.stage, { live, original } = this, [first] = this.jobs;
    const name = live ? say.now : this.jobs.length > 1 ? labels(this.jobs)[this.jobs.indexOf(job)] : resultName(job);
    if (!viewer || this.signal.aborted || (live && !(original && live.painted))) return;
    if (original && (live || (sceneOf(job) === sceneOf(first) && drawnAlike(job, first)))) {
      const fade = live?.ownScene ? 0 : (job.parameters.sh_attenuation ?? 0);
      try {
        await this.fetchColors(job, live?.painted ?? "colors.f16");
        return void this.choices.set(job.id, { name, side: { scene: original, colors: job.id, fade } });
      } catch (error) {
        if (live || !(error instanceof Problem) || error.status !== 404) throw error;
      }
    }
    const scene = viewer.open(new URL(this.files(job).result("stylized.ply"), location.href).href);
    this.choices.set(job.id, { name, side: { scene, colors: "own" } });
    if (!this.original) this.stage.show({ scene, colors: "own" });
    await scene.headerRead;
  }

  /** @param {any} job @param {string} name */
  async fetchColors(job, name) {
    const answer = await ask("GET", this.files(job).result(name), { signal: this.signal });
    await this.original?.addColors(job.id, /** @type {ReadableStream<Uint8Array>} */ (answer.body));
  }

  /** Show the present colors of the unfinished run. Calls while colors are being fetched lead to one more fetch. */
  async refresh() {
    const [job] = this.jobs;
    await this.loading;
    if (document.hidden || !this.original || !this.live) return;
    if (!this.live.painted) {
      this.live.painted = LIVE;
      return (this.loading = this.openRun(job).then(() => this.offer(), () => void (this.live && (this.live.painted = ""))));
    }
    if (this.stage.viewer?.crowded()) return;
    this.stale = true;
    this.fetching ??= this.fetchWhileStale(job);
    await this.fetching;
  }

  /** @param {any} job */
  async fetchWhileStale(job) {
    while (this.stale && this.live) {
      this.stale = false;
      this.live.painted = LIVE;
      await this.fetchColors(job, LIVE).catch(() => {}); // the next colors follow
    }
    this.fetching = undefined;
  }

  /** Show the result without loading the scene again. Return whether that is possible. @param {any} job */
  async finish(job) {
    const { original, live } = this;
    if (!original || live?.ownScene || job.parameters.sh_attenuation) return false;
    this.live = undefined;
    this.viewpoints.offer(job.id);
    this.standUp();
    await this.fetching; // older colors would replace the final ones
    try {
      await this.fetchColors(job, "colors.f16");
    } catch {
      return false;
    }
    this.choices.set(job.id, { name: resultName(job), side: { scene: original, colors: job.id } });
    this.offer();
    return true;
  }

  /** Offer the blend of one or two results if the viewer has all its color sets. */
  offerBlend() {
    const { original, blend, jobs } = this;
    if (!original || this.live || !this.blends || !jobs.every(({ id }) => original.colors.has(id))) return;
    const side = { scene: original, colors: jobs[0].id, blend: blend.parts };
    this.choices.set(jobs.length > 1 ? "blend" : jobs[0].id, { name: jobs.length > 1 ? words.blend.title : blend.name, side });
    blend.element.hidden = false;
  }

  /** Show the blend after a change: on the right if it is on no side yet. */
  showBlend() {
    const key = this.jobs.length > 1 ? "blend" : this.jobs[0].id, choice = this.choices.get(key);
    if (!choice) return;
    if (this.jobs.length < 2) choice.name = this.blend.name;
    if (![this.left.select.value, this.right.select.value].includes(key)) this.right.select.value = key;
    this.showSides();
  }

  offer() {
    const runs = [...this.choices.keys()];
    this.offerBlend();
    const all = [...this.choices];
    if (!all.length) return this.stage.message(words.job.noScene);
    const options = () => all.map(([key, { name }]) => h("option", { value: key }, name));
    put(this.left.select, options());
    put(this.right.select, options());
    this.left.select.value = this.jobs.length > 1 ? (runs.at(-2) ?? runs[0]) : runs[0];
    this.right.select.value = runs[runs.length - 1];
    this.showSides();
  }

  /** @param {string} [changed] name of the side whose choice has changed; the other side gives up an equal choice */
  showSides(changed) {
    const [other, same] = changed === say.right ? [this.left.select, this.right.select] : [this.right.select, this.left.select];
    if (other.value === same.value && this.shown) other.value = this.shown.find((/** @type {string} */ key) => key !== same.value) ?? other.value;
    this.shown = [this.left.select.value, this.right.select.value];
    const left = this.choices.get(this.left.select.value), right = this.choices.get(this.right.select.value);
    if (!left || !right) return;
    if (left === right) this.stage.show(left.side);
    else this.stage.show(left.side, right.side, [left.name, right.name]);
  }

  /** Return the first run's scene with its own colors; undefined until it is there. @returns {Side | undefined} */
  get own() {
    const { scene, colors, fade } = this.choices.get(this.jobs[0].id)?.side ?? {};
    return scene && colors ? { scene, colors, fade } : undefined;
  }

  /** Give the stage to another view. @param {boolean} shown whether what is shown is that view's original, and stays */
  handOver(shown) {
    const { viewer } = this.stage, scene = viewer?.sides?.left.scene, kept = shown && scene;
    for (const each of new Set([scene, ...[...this.choices.values()].map(({ side }) => side.scene)])) if (each !== kept) each?.end();
    this.choices.clear();
    if (viewer && !kept) viewer.sides = null;
    return this.stage;
  }

  /** @param {unknown} error */
  tell(error) {
    if (!this.signal.aborted) this.stage.message(messageOf(error));
  }

  end() {
    for (const { side } of this.choices.values()) side.scene.end();
    this.stage.end();
  }
}

/** Return where the files of a job are. @param {any} job @param {AbortSignal} signal @returns {Files} */
function filesOf(job, signal) {
  const inputs = `v1/jobs/${job.id}/inputs`;
  const cameras = async () => {
    const found = job.inputs.filter((/** @type {any} */ input) => input.role === "cameras");
    return Promise.all(found.map(async (/** @type {any} */ file, /** @type {number} */ i) => ({ name: file.name, blob: await (await ask("GET", `${inputs}/cameras:${i}`, { signal })).blob() })));
  };
  return { scene: `${inputs}/scene`, result: (name) => artifactPath(job.id, name), cameras };
}

/** @param {any} a @param {any} b @returns {boolean} whether two jobs draw their scene in the same render mode */
const drawnAlike = ({ parameters: a }, { parameters: b }) => a.render_mode === b.render_mode && a.eps2d === b.eps2d;

/** @param {any} job @returns {string} digest of the job's scene */
export const sceneOf = (job) => job.inputs.find((/** @type {any} */ input) => input.role === "scene")?.sha256 ?? job.id;

