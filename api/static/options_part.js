// @ts-check
/** Options of a new job: presets, and groups of options. */
import { get } from "./api.js";
import { h, newId, put } from "./dom.js";
import { addPictures, optionControl } from "./options.js";
import { words } from "./words.js";

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
    this.presets = h("fieldset.presets", h("legend", say.preset));
    this.main = h("div.options");
    this.ring = h("div.options");
    this.look = h("div.options");
    this.expert = h("div.options");
    this.lookFold = h("details.fold.group", h("summary", say.lookOptions), this.look);
    this.expertFold = h("details.fold.group", h("summary", say.expertOptions), h("p.help", say.expertHint), this.expert);
  }

  /** Make the controls. @param {AbortSignal} signal @param {(schema: any) => void} restore called before they show */
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
    const group = newId(), { default: usual, enum: presets } = schema.preset;
    this.follow(usual);
    put(this.presets, h("legend", say.preset), presets.map((/** @type {string} */ value) => h("label",
      h("input", { type: "radio", name: group, value, checked: value === usual, onchange: () => this.follow(value) }),
      h("span", h("strong", value), h("small", say.presets[value] ?? "")))));
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
    if (this.controls.get("within")?.value() === undefined) return;
    for (const [name, text] of [["resolution", say.byTime], ["views", say.byTime], ["early_stop", say.off]]) this.controls.get(name)?.suggest(text);
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
