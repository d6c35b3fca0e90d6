// @ts-check
/** Paintings of a new job: a gallery, whether several are blended, and the example. */
import { h, put } from "./dom.js";
import { defaultName } from "./names.js";
import { showWrong } from "./options.js";
import { choice } from "./views_part.js";
import { words } from "./words.js";

const say = words.submit;

export class PaintingsPart {
  /**
   * @param {import("./slots.js").Slot} slot
   * @param {import("./regions.js").RegionList} regions
   * @param {() => void} changed called after another way to use several paintings was chosen
   */
  constructor(slot, regions, changed) {
    this.slot = slot;
    this.regions = regions;
    /** Inputs for the shares of the paintings in a blend, by the paintings' names. @type {Record<string, any>} */
    this.weights = {};
    const gallery = h("details.fold", h("summary", words.gallery.title), h("p.help", words.gallery.bundled), h("div.paintings",
      Object.entries(words.gallery.paintings).map(([name, title]) => h("button.painting", { type: "button", title, "aria-label": words.gallery.use(title), onclick: async () => slot.add([await painting(name)]) },
        h("img", { src: address(name), alt: "", loading: "lazy", decoding: "async" })))));
    this.blended = choice("paintings", say.blended, true, changed);
    this.apart = choice("paintings", say.apart, false, changed);
    this.together = h("fieldset.segments.wide", { hidden: true }, h("legend.away", say.paintings), this.blended.element, this.apart.element);
    this.shares = h("div.options.shares", { hidden: true });
    this.shareError = h("p.wrong", { hidden: true });
    this.elements = [slot.element, gallery, this.together, this.shares];
  }

  /** Paintings that belong to no region. */
  get own() {
    const painted = this.regions.painted();
    return this.slot.files.filter(({ name }) => !painted[name]);
  }

  /** Number of jobs to create: one, or one per painting that belongs to no region. */
  get jobs() {
    return this.apart.input.checked ? Math.max(1, this.own.length) : 1;
  }

  /** Show which paintings belong to regions, and the shares of the others in a blend. */
  show() {
    const { own } = this, several = own.length > 1;
    this.slot.annotate(Object.fromEntries(Object.entries(this.regions.painted()).map(([name, regions]) => [name, say.paintingOf(regions)])));
    this.weights = Object.fromEntries(several ? own.map(({ name }) => [name, h("input", { type: "number", min: 0, step: "any", value: this.weights[name]?.value ?? "1", "aria-label": name })]) : []);
    this.together.hidden = !several;
    this.shares.hidden = !several || this.apart.input.checked;
    put(this.shares, h("p.help", say.weights), Object.entries(this.weights).map(([name, input]) => h("div.option.inline", h("span", name), input)), this.shareError);
  }

  /** Return the shares of the paintings in a blend; undefined if they are equal or there is none. */
  shareValues() {
    const own = Object.values(this.weights).map((input) => Number(input.value));
    return this.jobs === 1 && own.some((weight) => weight !== own[0]) ? own : undefined;
  }

  markInvalid() {
    const weight = this.jobs === 1 && Object.values(this.weights).find((input) => !(Number(input.value) > 0) || !Number.isFinite(Number(input.value)));
    if (weight) showWrong(weight, this.shareError, words.refusals.weight(weight.getAttribute("aria-label")));
  }

  clearWrong() {
    for (const weight of Object.values(this.weights)) showWrong(weight, this.shareError, "");
  }

  /** Return the bodies of the jobs: the given one, or one per painting. Paintings of regions belong to all of them. @param {any} body */
  bodies(body) {
    if (this.jobs === 1) return [body];
    const { files } = this.slot, { own } = this, { name } = body.parameters;
    const shared = body.style.filter((/** @type {string} */ _, /** @type {number} */ i) => !own.includes(files[i]));
    return files.flatMap((file, i) => !own.includes(file) ? [] : [{
      ...body, style: [body.style[i], ...shared], parameters: { ...body.parameters, ...(name ? { name: defaultName(name, [file.name]).slice(0, 200) } : {}) },
    }]);
  }

  kept() {
    return { weights: Object.fromEntries(Object.entries(this.weights).map(([name, input]) => [name, input.value])), apart: this.apart.input.checked };
  }

  /** @param {import("./stored.js").Draft} draft */
  restore({ weights, apart }) {
    this.weights = Object.fromEntries(Object.entries(weights).map(([name, value]) => [name, { value }]));
    this.apart.input.checked = apart;
  }
}

/** @param {string} name */
const address = (name) => new URL(`./paintings/${name}.jpg`, import.meta.url).href;

/** Return a file of the page as if it were chosen from this device. @param {string} url @param {string} name */
async function fetched(url, name) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(words.api.status(answer.status));
  const blob = await answer.blob();
  return new File([blob], name, { type: blob.type, lastModified: 0 }); // the same upload every time
}

/** Return a painting of the page. @param {string} name */
const painting = (name) => fetched(address(name), `${name}.jpg`);

/** Name of the example's scene. */
export const EXAMPLE = "motorcycle.sog";

export class ExamplePart {
  /** @param {() => void} start called when a user wants the example */
  constructor(start) {
    this.button = h("button.quiet", { type: "button", onclick: start }, words.example.start);
    this.element = h("div.example", this.button, h("small", words.example.credit));
  }

  async files() {
    this.button.textContent = words.example.preparing;
    try {
      const parts = [EXAMPLE, "cameras.json"].map((name) => fetched(new URL(`./example/${name}`, import.meta.url).href, name));
      const [scene, cameras, style] = await Promise.all([...parts, painting("starry_night")]);
      return { scene: [scene], style: [style], cameras: [cameras] };
    } finally {
      this.button.textContent = words.example.start;
    }
  }
}
