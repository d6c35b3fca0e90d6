// @ts-check
/** Control of a blend of the original with one or two results; the viewer shows it exactly. */
import { artifactPath, ask } from "./api.js";
import { announce, h, messageOf, newId, put } from "./dom.js";
import { resultName } from "./names.js";
import { resultFormats } from "./tables.js";
import { words } from "./words.js";

const say = words.blend;

export class Blend {
  /**
   * @param {any[]} jobs one or two finished jobs of one scene
   * @param {string[]} names their names
   * @param {() => void} changed called after each change of the weights
   * @param {boolean} stored whether the service can store the blend
   */
  constructor(jobs, names, changed, stored = true) {
    this.jobs = jobs;
    this.changed = changed;
    /** Fraction of style, 0 to 1.5, and of the second result in it, 0 to 1. */
    this.style = 1;
    this.second = jobs.length > 1 ? 0.5 : 0;
    /** Color sets with their weights: the original, then the results. @type {import("./viewer/viewer.js").Part[]} */
    this.parts = ["own", ...jobs.map(({ id }) => id)].map((colors) => ({ colors, weight: 0 }));
    this.styleSlider = this.slider(say.style, 150, (value) => (this.style = value));
    this.secondSlider = this.slider(say.between(names[0], names[1] ?? ""), 100, (value) => (this.second = value));
    this.format = h("select", { "aria-label": say.saveAs }, resultFormats.map(({ name, title }) => h("option", { value: name }, title)));
    this.button = h("button.quiet", { type: "button", onclick: () => this.save() }, say.save);
    this.note = h("p.help", { role: "status" });
    const sliders = h("div.sliders", this.styleSlider.element, jobs.length > 1 && this.secondSlider.element);
    this.element = h("fieldset.blend", h("legend", say.title), jobs.length > 1 && this.triangle(names), sliders, h("div.row", { hidden: !stored }, this.button, this.format), this.note);
    this.weigh();
  }

  /** @param {string} name @param {number} most maximum in percent @param {(value: number) => void} set */
  slider(name, most, set) {
    const id = newId(), output = h("output", { htmlFor: id }), mark = h("datalist", { id: `${id}m` }, h("option", { value: 100 }));
    const input = h("input", { id, type: "range", list: most > 100 ? mark.id : null, min: 0, max: most, step: 1, oninput: () => {
      set(Number(input.value) / 100);
      this.weigh();
      this.changed();
    } });
    return { input, output, element: h("div.slider", h("label", { htmlFor: id }, name), input, output, mark) };
  }

  /** Create the triangle, for pointers; the sliders reach the same blends. @param {string[]} names */
  triangle(names) {
    this.dot = h("span.dot");
    this.area = h("div.area", h("span.shape"), this.dot);
    const follow = (/** @type {PointerEvent} */ event) => {
      const { left, top, width, height } = this.area.getBoundingClientRect();
      this.style = Math.round(100 * Math.max(0, Math.min(1, (event.clientY - top) / height))) / 100;
      const across = (event.clientX - left) / width - 0.5; // from -style/2 to style/2 within the triangle
      this.second = this.style ? Math.round(100 * Math.max(0, Math.min(1, across / this.style + 0.5))) / 100 : this.second;
      this.weigh();
      this.changed();
    };
    this.area.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
      this.area.setPointerCapture(event.pointerId);
      follow(event);
    });
    this.area.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => event.buttons && follow(event));
    return h("div.triangle", { "aria-hidden": "true" }, h("span.corner", words.viewer.original), this.area, h("div.corners", names.map((name) => h("span.corner", name))));
  }

  weigh() {
    const { style, second } = this;
    const weights = this.jobs.length > 1 ? [1 - style, style * (1 - second), style * second] : [1 - style, style];
    this.parts.forEach((part, i) => (part.weight = weights[i]));
    for (const [{ input, output }, value] of /** @type {const} */ ([[this.styleSlider, style], [this.secondSlider, second]])) {
      input.value = String(Math.round(100 * value));
      output.textContent = say.percent(value);
      input.setAttribute("aria-valuetext", output.textContent);
    }
    if (!this.dot) return;
    const down = Math.min(1, style);
    this.dot.style.top = `${100 * down}%`;
    this.dot.style.left = `${100 * (0.5 + (second - 0.5) * down)}%`;
  }

  /** Name of the blend of one result. */
  get name() {
    return this.style === 1 ? resultName(this.jobs[0]) : say.amount(this.style);
  }

  /** Store the blend on the service, and download it. */
  async save() {
    const [first, ...others] = this.jobs, weights = this.parts.slice(1).map(({ weight }) => weight);
    const json = { weight: weights[0], others: others.map(({ id }, i) => ({ job_id: id, weight: weights[i + 1] })), format: this.format.value };
    this.button.disabled = true;
    put(this.note, say.saving);
    try {
      const { name } = await (await ask("POST", `v1/jobs/${first.id}/blends`, { json })).json();
      const href = artifactPath(first.id, name);
      h("a", { href, download: "" }).click();
      put(this.note, say.saved, " ", h("a", { href, download: "" }, name.split("/").pop()));
      announce(say.saved);
    } catch (error) {
      put(this.note, messageOf(error));
    }
    this.button.disabled = false;
  }
}
