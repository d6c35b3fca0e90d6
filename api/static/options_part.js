// @ts-check
/** Options of a new job: presets with their estimated times, and groups of options that can be searched. */
import { ask, get } from "./api.js";
import { h, newId, put } from "./dom.js";
import { addPictures, optionControl } from "./options.js";
import { seconds, words } from "./words.js";

/** @typedef {import("./options.js").Control} Control */

const say = words.submit;
/** Parameters that other parts of the form set. */
const ELSEWHERE = ["name", "style_weights", "regions", "painted", "preset"];

export class OptionsPart {
  /** @param {Control} name control for the job's name, which is shown elsewhere */
  constructor(name) {
    /** @type {Map<string, Control>} */
    this.controls = new Map([["name", name]]);
    /** Names of options by group, from the API's document. @type {Record<string, string[]>} */
    this.groups = { Essentials: [], Views: [], Look: [], Expert: [] };
    /** @type {any} */
    this.schema = null;
    /** @type {string | undefined} */
    this.preset = undefined;
    /** Time budget in seconds that suits the service's machine. */
    this.budget = 0;
    /** Elements with the estimated time of each preset. @type {Map<string, HTMLElement>} */
    this.times = new Map();
    this.presets = h("fieldset.presets", h("legend", say.preset));
    this.main = h("div.options");
    this.ring = h("div.options");
    this.look = h("div.options");
    this.expert = h("div.options");
    this.search = h("input", { type: "search", "aria-label": say.find, placeholder: say.find, oninput: () => this.filter() });
    this.none = h("p.quiet", { hidden: true }, say.noOptions);
    this.lookFold = h("details.fold.group", h("summary", say.lookOptions), this.look);
    this.expertFold = h("details.fold.group", h("summary", say.expertOptions), h("p.help", say.expertHint), this.expert);
  }

  /**
   * Make the controls that the API's document describes.
   *
   * @param {AbortSignal} signal
   * @param {(schema: any) => void} restore called before the controls are shown with their pictures
   */
  async load(signal, restore) {
    let schema;
    try {
      ({ within: this.budget } = await get("v1/session", signal));
      const document = await get("openapi.json", signal), parameters = document.components.schemas.JobParameters;
      schema = parameters.properties;
      this.groups = parameters["x-groups"];
    } catch {
      if (!signal.aborted) put(this.main, h("p.quiet", say.optionsAway));
      return;
    }
    for (const [name, each] of Object.entries(schema)) {
      if (!ELSEWHERE.includes(name)) this.controls.set(name, optionControl(name, each, name === "orbit" ? { title: say.howMany } : {}));
    }
    this.makePresets(schema.preset);
    const { Essentials, Views, Look, Expert } = this.groups;
    for (const [place, names] of /** @type {[HTMLElement, string[]][]} */ ([[this.main, Essentials], [this.ring, Views], [this.look, Look], [this.expert, [...Expert, "retention_days"]]])) {
      put(place, names.map((name) => this.controls.get(name)?.element));
    }
    const followStrength = addPictures(/** @type {Control} */ (this.controls.get("content_weight")));
    this.schema = schema;
    this.controls.get("within")?.element.addEventListener("input", () => this.preset && this.follow(this.preset));
    restore(schema);
    followStrength();
  }

  /** @param {any} schema */
  makePresets(schema) {
    const name = newId();
    this.follow(schema.default);
    put(this.presets, h("legend", say.preset), schema.enum.map((/** @type {string} */ value) => h("label",
      h("input", { type: "radio", name, value, checked: value === schema.default, onchange: () => this.follow(value) }),
      h("span", h("strong", value), h("small", say.presets[value] ?? ""), this.times.get(value) ?? this.newTime(value)))));
  }

  /** Choose a preset, unless the service does not have it. @param {string} preset */
  choose(preset) {
    const input = [...this.presets.querySelectorAll("input")].find((/** @type {any} */ each) => each.value === preset);
    if (!input) return;
    /** @type {any} */ (input).checked = true;
    this.follow(preset);
  }

  /** Show the defaults of a preset. @param {string} preset */
  follow(preset) {
    this.preset = preset;
    for (const control of this.controls.values()) control.follow(preset);
    if (this.controls.get("within")?.value() !== undefined) for (const name of ["resolution", "views"]) this.controls.get(name)?.suggest(say.byTime);
  }

  /** Create the element for the estimated time of a preset. @param {string} preset */
  newTime(preset) {
    const element = h("small.time");
    this.times.set(preset, element);
    return element;
  }

  /** Discard the estimated times of the presets, which were made for other files or options. */
  forgetTimes() {
    this.timing?.abort();
    for (const element of this.times.values()) element.textContent = "";
  }

  /**
   * Show the estimated time at each preset. The other presets are estimated one after another; the service remembers
   * what it has planned.
   *
   * @param {any} body job whose plan is known
   * @param {any} view its plan
   */
  async showTimes(body, view) {
    this.forgetTimes();
    const { signal } = (this.timing = new AbortController());
    const tell = (/** @type {string} */ preset, /** @type {any} */ { total_seconds: total }) => void (/** @type {any} */ (this.times.get(preset)).textContent = total === null ? "" : say.about(seconds(total)));
    tell(body.parameters.preset, view);
    for (const preset of this.times.keys()) {
      if (preset === body.parameters.preset || signal.aborted) continue;
      try {
        tell(preset, await (await ask("POST", "v1/jobs?dry_run=true", { json: { ...body, parameters: { ...body.parameters, preset } }, signal })).json());
      } catch {
        // this preset is shown without a time
      }
    }
  }

  filter() {
    const wanted = this.search.value.trim().toLowerCase();
    let shown = 0;
    for (const { name, title, help, element } of this.controls.values()) {
      if (!this.groups.Look.includes(name) && !this.groups.Expert.includes(name)) continue;
      element.hidden = !!wanted && !`${title} ${name.replaceAll("_", " ")} ${name} ${help}`.toLowerCase().includes(wanted);
      shown += element.hidden ? 0 : 1;
    }
    this.none.hidden = shown > 0;
    for (const fold of [this.lookFold, this.expertFold]) {
      if (wanted) fold.open = true;
      fold.hidden = ![...fold.querySelectorAll(".option")].some((/** @type {any} */ element) => !element.hidden);
    }
  }

  /** Return the values that are not left to the preset, by name. @param {Control[]} [controls] @returns {Record<string, any>} */
  values(controls = [...this.controls.values()]) {
    return Object.fromEntries(controls.map((control) => [control.name, control.value()]).filter(([, value]) => value !== undefined));
  }

  /** Return the controls that apply. @param {boolean} orbiting whether the job orbits the scene */
  applying(orbiting) {
    return [...this.controls.values()].filter(({ name }) => (orbiting ? name !== "views" : !this.groups.Views.includes(name)));
  }

  /** Return the parameters of a job. @param {boolean} orbiting whether it orbits the scene */
  parameters(orbiting) {
    return { ...(orbiting ? { orbit: "auto" } : {}), ...this.values(this.applying(orbiting)), ...(this.preset ? { preset: this.preset } : {}) };
  }

  /** Fill in the time budget that suits the service's machine. */
  useBudget() {
    this.restore({ within: this.budget }, undefined);
  }

  /** Return to the values of a new form. */
  reset() {
    for (const control of this.controls.values()) control.set(undefined);
    this.choose(this.schema?.preset.default);
    this.useBudget();
  }

  /** Fill in values. @param {Record<string, any>} values by name @param {string | undefined} preset */
  restore(values, preset) {
    for (const [name, value] of Object.entries(values)) {
      if (JSON.stringify(value) !== JSON.stringify(this.schema?.[name]?.default)) this.controls.get(name)?.set(Array.isArray(value) ? value.join(", ") : value);
    }
    if (preset) this.choose(preset);
    else if (this.preset) this.follow(this.preset);
  }
}
