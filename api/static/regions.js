// @ts-check
/** Regions of a scene, each with its own style or frozen. */
import { h, icon, newId, put } from "./dom.js";
import { paintingsOf } from "./names.js";
import { showWrong, strengthName } from "./options.js";
import { contentOf } from "./stored.js";
import { words } from "./words.js";

const say = words.submit, hand = words.select;
/** Name of the region of all Gaussians that no other one selects. */
const REST = "rest";

/** @typedef {import("./select_panel.js").Mask} Mask */
/** @typedef {import("./stored.js").Chosen} Chosen */
/** @typedef {Mask & {file: Chosen}} StoredMask mask with its file, which stays the same while the mask does */
/** @typedef {{element: HTMLElement, value: () => any, mask: () => StoredMask | null, setMask: (mask: Mask | null) => void, set: (region: any) => void, setStyles: () => void, wrong: (text: string, field?: string) => void}} Row */

export class RegionList {
  /**
   * @param {() => void} changed called after a region was added, removed or changed
   * @param {(row: Row) => void} [select] called to select the Gaussians of a region in the 3D view
   */
  constructor(changed, select) {
    this.changed = changed;
    this.select = select;
    /** @type {Row[]} */
    this.rows = [];
    this.made = 0;
    /** Files of masks from an earlier job. @type {Chosen[]} */
    this.earlier = [];
    /** @type {string[]} */
    this.styles = [];
    this.list = h("div.regions");
    this.element = h("div", { oninput: changed }, this.list, h("button.quiet.small", { type: "button", onclick: () => this.add().element.querySelector("button")?.focus() }, icon("plus"), say.addRegion));
  }

  /** Box that the scene is cropped to, such as "-1,-1,-1,1,1,1"; "" for none. */
  get box() {
    const [first] = this.value(), frozen = this.value().some(({ name, freeze }) => name === REST && freeze);
    return frozen && first.name === words.crop.inside ? /^box=(.*)/.exec(first.select)?.[1] ?? "" : "";
  }

  /** Paint only what is inside a box, and freeze the rest. @param {string} box "" to paint everything */
  crop(box) {
    for (const row of this.rows.filter((row) => [words.crop.inside, REST].includes(row.value().name))) this.drop(row);
    if (box) {
      this.add(true).set({ name: words.crop.inside, select: `box=${box}` });
      this.add().set({ name: REST, freeze: true });
    }
    this.changed();
  }

  /** @param {Row} row */
  drop(row) {
    this.rows = this.rows.filter((each) => each !== row);
    row.element.remove();
    this.changed();
  }

  /** @param {boolean} [first] whether to add it before the others, which win where they overlap */
  add(first = false) {
    const number = ++this.made;
    const field = (/** @type {string} */ title, /** @type {any} */ input) => {
      input.id = newId();
      return h("div.option", h("label", { htmlFor: input.id }, title), input);
    };
    const name = h("input", { type: "text", value: say.part(number), maxLength: 64, autocomplete: "off" });
    const select = h("input", { type: "text", placeholder: "sphere=0,1.4,0,0.3", autocomplete: "off" });
    const weight = h("input", { type: "number", min: 0, step: "any", value: "1" });
    const strength = h("select"), style = h("select"), freeze = h("input", { type: "checkbox" });
    /** Fill a chooser, and choose a value, which it offers even if it is not one of the usual. */
    const fill = (/** @type {any} */ chooser, /** @type {[string, string][]} */ usual, /** @type {string} */ chosen, /** @type {string} */ title) => {
      const others = chosen && !usual.some(([value]) => value === chosen) ? [[chosen, title]] : [];
      put(chooser, h("option", { value: "" }, say.ownStyle), [...usual, ...others].map(([value, text]) => h("option", { value }, text)));
      chooser.value = chosen;
    };
    /** Painting of the region in JSON: a name, or a list of names with weights. */
    const setStyle = (/** @type {string} */ chosen) => {
      const names = paintingsOf({ style: chosen && JSON.parse(chosen) }), there = names.every((each) => this.styles.includes(each));
      fill(style, this.styles.map((each) => [JSON.stringify(each), each]), there ? chosen : "", names.join(" + "));
    };
    setStyle("");
    fill(strength, Object.entries(words.strengths.titles), "", "");
    /** @type {StoredMask | null} */
    let mask = null;
    const text = () => (mask ? `mask=${mask.file.name}` : select.value.trim());
    const value = () => ({ name: name.value.trim(), ...(text() ? { select: text() } : {}), ...(freeze.checked || weight.value === "1" ? {} : { weight: Number(weight.value) }), ...(style.value && !freeze.checked ? { style: JSON.parse(style.value) } : {}), ...(strength.value && !freeze.checked ? { content_weight: isNaN(strength.value) ? strength.value : Number(strength.value) } : {}), ...(freeze.checked ? { freeze: true } : {}) });
    const picked = h("span");
    const pick = h("button.small", { type: "button", hidden: !this.select, onclick: () => this.select?.(row) });
    const drop = h("button.quiet.small", { type: "button", onclick: () => setMask(null) }, hand.forget);
    const written = h("details", { open: !this.select }, h("summary", hand.written), field(say.regionSelect, select));
    const setMask = (/** @type {Mask | StoredMask | null} */ made) => {
      mask = made && { ...made, file: "file" in made ? made.file : new File([/** @type {BlobPart} */ (made.bits)], this.freeName(row)) };
      written.hidden = !!mask;
      drop.hidden = !mask;
      pick.textContent = mask ? hand.change : hand.byHand;
      pick.classList.toggle("primary", !mask);
      pick.classList.toggle("quiet", !!mask);
      picked.textContent = mask ? hand.made(mask.total) : "";
      this.changed();
    };
    const error = h("p.wrong", { id: newId(), hidden: true });
    const remove = h("button.tool", { type: "button", "aria-label": say.remove(say.region(number)), onclick: () => this.drop(row) }, icon("close"));
    const element = h("fieldset.region", h("legend", say.region(number)), h("div.handmade", picked, pick, drop), field(say.regionName, name), field(say.style, style), field(say.regionStrength, strength), field(hand.weight, weight), h("label.check", freeze, h("span", say.freeze)), written, error, remove);
    const inputs = /** @type {Record<string, any>} */ ({ name, select, style, weight, content_weight: strength, freeze, pick });
    for (const input of Object.values(inputs)) input.setAttribute("aria-describedby", error.id);
    const wrong = (/** @type {string} */ text, field = "select") => {
      for (const input of Object.values(inputs)) showWrong(input, error, "");
      const place = field === "select" && (mask || !select.value) && this.select ? pick : inputs[field] ?? select;
      if (text) showWrong(place, error, text);
    };
    const set = (/** @type {any} */ region) => {
      name.value = region.name;
      select.value = region.select ?? "";
      freeze.checked = !!region.freeze;
      weight.value = String(region.weight ?? 1);
      const paintings = paintingsOf(region);
      setStyle(paintings.length ? JSON.stringify(paintings.length > 1 ? region.style : paintings[0]) : "");
      const kept = String(region.content_weight ?? "");
      fill(strength, Object.entries(words.strengths.titles), kept && strengthName(kept), kept);
      written.open = !this.select || (!!region.select && !region.mask);
      setMask(region.mask ?? null);
      if (mask) select.value = "";
    };
    /** @type {Row} */
    const row = { element, value, mask: () => mask, setMask, set, setStyles: () => setStyle(style.value), wrong };
    element.addEventListener("input", () => wrong(""));
    this.rows.splice(first ? 0 : this.rows.length, 0, row);
    this.list.insertBefore(element, first ? this.list.firstChild : null);
    setMask(null);
    return row;
  }

  /** Return a name for the mask of a region that no other region's has. @param {Row} row */
  freeName(row) {
    const used = this.rows.filter((each) => each !== row).map((each) => each.value().select);
    for (let n = 1; ; n++) if (!used.includes(`mask=region_${n}.bin`)) return `region_${n}.bin`;
  }

  /** Return the files of the masks: those selected by hand, and those from an earlier job that a region still names. */
  maskFiles() {
    const made = this.rows.flatMap((row) => row.mask()?.file ?? []), names = made.map(({ name }) => name), selections = this.value().map(({ select }) => String(select ?? ""));
    const used = (/** @type {string} */ name) => selections.some((select) => select === `mask=${name}` || (select.startsWith("masks=") && name.startsWith(select.slice(6))));
    return [...made, ...this.earlier.filter(({ name }) => used(name) && !names.includes(name))];
  }

  /** Show masks of an earlier job as selections by hand. @param {() => boolean} fit whether the scene is still the same */
  async restoreMasks(fit) {
    for (const row of this.rows) {
      const file = this.earlier.find(({ name }) => row.value().select === `mask=${name}` && /\.bin$/i.test(name));
      if (!file || row.mask()) continue;
      const bits = new Uint8Array(await (await contentOf(file)).arrayBuffer());
      let total = 0;
      for (let byte of bits) for (; byte; byte &= byte - 1) total++;
      if (fit()) row.set({ ...row.value(), mask: { bits, total, file } });
    }
  }

  /** Return the regions with their masks, for `Row.set`. */
  kept() {
    return this.rows.map((row) => ({ ...row.value(), mask: row.mask() }));
  }

  clearWrong() {
    for (const row of this.rows) row.wrong("");
  }

  markMissing() {
    for (const row of this.rows) {
      const { name, select } = row.value();
      if (!name) row.wrong(say.needName, "name");
      else if (!select && name !== REST) row.wrong(say.needSelection);
    }
  }

  /** Show a refusal in the region that caused it; return whether one did. @param {string} at @param {string} message */
  refuse(at, message) {
    const [, number, field] = /\bregions\.(\d+)(?:\.(\w+))?/.exec(at) ?? [];
    const named = (/** @type {Row} */ row) => ["'", '"'].some((quote) => message.includes(`egion ${quote}${row.value().name}${quote}`));
    const row = number !== undefined ? this.rows[Number(number)] : this.rows.find(named);
    row?.wrong(message, field);
    return !!row;
  }

  /** @param {string[]} names names of the style files */
  setStyles(names) {
    this.styles = names;
    this.rows.forEach((row) => row.setStyles());
  }

  /** Return the regions that have a painting, by its name: `{"night.jpg": ["left"]}`. @returns {Record<string, string[]>} */
  painted() {
    /** @type {Record<string, string[]>} */
    const found = {};
    for (const region of this.value()) for (const name of paintingsOf(region)) (found[name] ??= []).push(region.name);
    return found;
  }

  value() {
    return this.rows.map((row) => row.value());
  }
}
