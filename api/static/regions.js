// @ts-check
/** Regions of a scene, each with its own style or frozen. */
import { h, icon, newId, put } from "./dom.js";
import { showWrong } from "./options.js";
import { words } from "./words.js";

const say = words.submit, hand = words.select;

/** @typedef {import("./select_panel.js").Mask} Mask */
/** @typedef {import("./stored.js").Chosen} Chosen */
/** @typedef {{element: HTMLElement, value: () => any, mask: () => Mask | null, setMask: (mask: Mask | null) => void, set: (region: any) => void, setStyles: (names: string[]) => void, wrong: (text: string, field?: string) => void}} Row */

export class RegionList {
  /** @param {(row: Row) => void} [select] called to select the Gaussians of a region in the 3D view */
  constructor(select) {
    this.select = select;
    /** @type {Row[]} */
    this.rows = [];
    /** Files of masks, which stay the same while name and mask do. @type {Map<Uint8Array, Chosen>} */
    this.files = new Map();
    /** @type {string[]} */
    this.styles = [];
    this.list = h("div.regions");
    this.element = h("div", this.list, h("button.quiet.small", { type: "button", onclick: () => this.add().element.querySelector("input")?.focus() }, icon("plus"), say.addRegion));
  }

  add() {
    const field = (/** @type {string} */ title, /** @type {any} */ input) => {
      input.id = newId();
      return h("div.option", h("label", { htmlFor: input.id }, title), input);
    };
    const name = h("input", { type: "text", placeholder: "face", pattern: "[A-Za-z][A-Za-z0-9_\\-]{0,31}", autocomplete: "off" });
    const select = h("input", { type: "text", placeholder: "sphere=0,1.4,0,0.3", autocomplete: "off" });
    const weight = h("input", { type: "number", min: 0, step: "any", value: "1" });
    const strength = h("input", { type: "text", placeholder: say.ownStyle, autocomplete: "off" });
    const style = h("select"), freeze = h("input", { type: "checkbox" });
    const setStyles = (/** @type {string[]} */ names) => {
      const before = style.value;
      put(style, h("option", { value: "" }, say.ownStyle), names.map((each) => h("option", { value: each }, each)));
      style.value = names.includes(before) ? before : "";
    };
    setStyles(this.styles);
    /** @type {Mask | null} */
    let mask = null;
    const text = () => (mask ? `mask=${name.value.trim()}.bin` : select.value.trim());
    const value = () => ({ name: name.value.trim(), ...(text() ? { select: text() } : {}), ...(freeze.checked || weight.value === "1" ? {} : { weight: Number(weight.value) }), ...(style.value && !freeze.checked ? { style: style.value } : {}), ...(strength.value.trim() && !freeze.checked ? { content_weight: Number.isNaN(Number(strength.value)) ? strength.value.trim() : Number(strength.value) } : {}), ...(freeze.checked ? { freeze: true } : {}) });
    const selectField = field(say.regionSelect, select), picked = h("span");
    const pick = h("button.quiet.small", { type: "button", hidden: !this.select, onclick: () => this.select?.(row) });
    const drop = h("button.quiet.small", { type: "button", onclick: () => setMask(null) }, hand.forget);
    const handmade = h("div.handmade", picked, pick, drop);
    const setMask = (/** @type {Mask | null} */ made) => {
      mask = made;
      selectField.hidden = !!mask;
      drop.hidden = !mask;
      pick.textContent = mask ? hand.change : hand.byHand;
      picked.textContent = mask ? hand.made(mask.total) : "";
    };
    setMask(null);
    const element = h("fieldset.region", h("legend", say.region(this.rows.length + 1)), field(say.regionName, name), selectField, handmade, field(say.style, style), field(hand.weight, weight), field(words.options.titles.content_weight, strength), h("label.check", freeze, h("span", say.freeze)));
    const error = h("p.wrong", { id: newId(), hidden: true });
    const inputs = /** @type {Record<string, any>} */ ({ name, select, style, weight, content_weight: strength, freeze });
    for (const input of Object.values(inputs)) input.setAttribute("aria-describedby", error.id);
    const wrong = (/** @type {string} */ text, field = "select") => {
      for (const input of Object.values(inputs)) showWrong(input, error, "");
      if (text) showWrong(inputs[field] ?? select, error, text);
    };
    const set = (/** @type {any} */ region) => {
      [name.value, select.value, style.value] = [region.name, region.select ?? "", region.style ?? ""];
      freeze.checked = !!region.freeze;
      weight.value = String(region.weight ?? 1);
      strength.value = String(region.content_weight ?? "");
      setMask(region.mask ?? null);
      if (mask) select.value = "";
    };
    const row = { element, value, mask: () => mask, setMask, set, setStyles, wrong };
    const remove = h("button.tool", { type: "button", "aria-label": say.remove(say.region(this.rows.length + 1)), onclick: () => ((this.rows = this.rows.filter((each) => each !== row)), element.remove()) }, icon("close"));
    element.append(error, remove);
    element.addEventListener("input", () => wrong(""));
    this.rows.push(row);
    this.list.append(element);
    return row;
  }

  /** Rows that are sent; the others are empty. */
  get sent() {
    return this.rows.filter((row) => row.value().name || row.value().select);
  }

  /** Return the files of the masks of all sent regions. */
  masks() {
    return this.sent.flatMap((row) => {
      const mask = row.mask(), { name } = row.value();
      if (!mask) return [];
      const known = this.files.get(mask.bits), file = known?.name === `${name}.bin` ? known : new File([/** @type {BlobPart} */ (mask.bits)], `${name}.bin`);
      this.files.set(mask.bits, file);
      return [file];
    });
  }

  /**
   * Show a mask of an earlier job as a selection by hand.
   *
   * @param {Row} row region that names the mask
   * @param {Uint8Array} bits
   * @param {Chosen} file the mask's file, which is not sent again
   */
  restoreMask(row, bits, file) {
    let total = 0;
    for (let byte of bits) for (; byte; byte &= byte - 1) total++;
    row.set({ ...row.value(), mask: { bits, total } });
    this.files.set(bits, file);
  }

  /** Remove masks, which belong to another scene. */
  dropMasks() {
    for (const row of this.rows) row.setMask(null);
  }

  /** Return the regions for `restore`. */
  kept() {
    return this.rows.map((row) => ({ ...row.value(), mask: row.mask() }));
  }

  /** @param {any[]} regions */
  restore(regions) {
    for (const region of regions) this.add().set(region);
  }

  clearWrong() {
    for (const row of this.rows) row.wrong("");
  }

  /**
   * Show a refusal in the region that caused it. Return the region's element, or undefined if none did.
   *
   * @param {string} at path of the refused parameter, such as "regions.0.select"
   * @param {string} message
   */
  refuse(at, message) {
    const [, number, field] = /\bregions\.(\d+)(?:\.(\w+))?/.exec(at) ?? [], named = /\b[Rr]egion '?([A-Za-z][\w-]*)/.exec(message)?.[1];
    const row = number !== undefined ? this.sent[Number(number)] : this.rows.find((each) => named && each.value().name === named);
    row?.wrong(message, field);
    return row?.element;
  }

  /** @param {string[]} names names of the style files */
  setStyles(names) {
    this.styles = names;
    this.rows.forEach((row) => row.setStyles(names));
  }

  value() {
    return this.sent.map((row) => row.value());
  }
}
