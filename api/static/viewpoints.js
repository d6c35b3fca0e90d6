// @ts-check
/** Viewpoints of a result: a list of buttons, a path through them, and for the maker of the result, their choice. */
import { ask } from "./api.js";
import { announce, h, icon, messageOf, put } from "./dom.js";
import { tool } from "./fields.js";
import { words } from "./words.js";

/** @typedef {import("./cameras.js").JobCamera} JobCamera */
/** @typedef {{start: JobCamera | null, named: JobCamera[]}} Viewpoints */

const say = words.viewpoints;
/** Maximum number of named viewpoints, as on the service. */
const MOST = 12;

export class ViewpointsPanel {
  /**
   * @param {import("./stage.js").Stage} stage
   * @param {Viewpoints} [viewpoints]
   * @param {string} [jobId] id of the job whose viewpoints may be changed; "" if they may not
   */
  constructor(stage, viewpoints = { start: null, named: [] }, jobId = "") {
    this.stage = stage;
    this.jobId = jobId;
    this.list = h("ol.viewpoints", { "aria-label": say.title });
    this.path = h("button.quiet.small", { type: "button", onclick: () => stage.fly(this.viewpoints.named) }, icon("play"), h("span", say.path));
    this.name = h("input", { type: "text", maxLength: 60, "aria-label": say.name, placeholder: say.name, autocomplete: "off" });
    this.starts = h("button.quiet.small", { type: "button", onclick: () => this.save({ ...this.viewpoints, start: stage.viewpoint("") }, say.started) }, say.start);
    this.unstart = h("button.quiet.small", { type: "button", onclick: () => this.save({ ...this.viewpoints, start: null }, say.reset) }, say.usual);
    this.adds = h("button.quiet.small", { type: "submit" }, icon("plus"), h("span", say.add));
    this.note = h("p.help", { role: "status" });
    this.form = h("form.row", { onsubmit: (/** @type {Event} */ event) => (event.preventDefault(), this.add()) }, this.starts, this.unstart, this.name, this.adds);
    this.element = h("section.viewpoints", { "aria-label": say.title });
    this.viewpoints = viewpoints;
    if (stage.controls) stage.controls.keys.viewpoint = (index) => this.go(index);
    this.use(viewpoints);
  }

  /** Let the viewpoints of a job be changed. @param {string} jobId */
  offer(jobId) {
    this.jobId = jobId;
    this.use(this.viewpoints);
  }

  /** @param {Viewpoints} viewpoints */
  use(viewpoints) {
    const { start, named } = viewpoints, { stage, jobId } = this, changes = !!(jobId && stage.viewer);
    this.viewpoints = viewpoints;
    stage.start = start;
    put(this.element, this.list, this.path, changes && [this.form, this.note]);
    put(this.list, named.map((viewpoint, i) => h("li", h("button.quiet.small", { type: "button", "aria-keyshortcuts": i < 9 ? String(i + 1) : null, onclick: () => this.go(i) }, `${i + 1} · ${viewpoint.name}`),
      changes && tool("close", say.remove(viewpoint.name), () => this.save({ start, named: named.filter((each) => each !== viewpoint) }, say.removed)))));
    this.list.hidden = !named.length;
    this.path.hidden = named.length < 2;
    this.unstart.hidden = !start;
    this.name.disabled = this.adds.disabled = named.length >= MOST;
    this.element.hidden = !stage.viewer || (!changes && !named.length);
  }

  /** @param {number} index */
  go(index) {
    const viewpoint = this.viewpoints.named[index];
    if (!viewpoint) return;
    this.stage.fly([viewpoint]);
    announce(viewpoint.name);
  }

  async add() {
    const { named, start } = this.viewpoints, taken = named.map(({ name }) => name);
    let number = named.length + 1;
    while (taken.includes(say.numbered(number))) number++;
    const added = this.stage.viewpoint(this.name.value.trim() || say.numbered(number));
    if (await this.save({ start, named: [...named, added] }, say.added(added.name))) this.name.value = "";
  }

  /** @param {Viewpoints} viewpoints @param {string} done @returns {Promise<boolean>} whether they are stored */
  async save(viewpoints, done) {
    this.note.textContent = say.saving;
    this.form.inert = this.list.inert = true;
    try {
      const job = await (await ask("PATCH", `v1/jobs/${this.jobId}`, { json: { viewpoints } })).json();
      this.use(job.viewpoints);
      this.note.textContent = done;
      return true;
    } catch (error) {
      this.note.textContent = messageOf(error);
      return false;
    } finally {
      this.form.inert = this.list.inert = false;
    }
  }
}
