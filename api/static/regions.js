// @ts-check
/** Regions of a scene, each with its own style or frozen. */
import { h, icon, newId, put } from "./dom.js";
import { words } from "./words.js";

const say = words.submit;

export class RegionList {
  constructor() {
    /** @type {{element: HTMLElement, value: () => any, setStyles: (names: string[]) => void}[]} */
    this.rows = [];
    /** @type {string[]} */
    this.styles = [];
    this.list = h("div.regions");
    this.element = h("div", this.list, h("button.quiet.small", { type: "button", onclick: () => this.add() }, icon("plus"), say.addRegion));
  }

  add() {
    const field = (/** @type {string} */ title, /** @type {any} */ input) => {
      input.id = newId();
      return h("div.option", h("label", { htmlFor: input.id }, title), input);
    };
    const name = h("input", { type: "text", placeholder: "face", pattern: "[A-Za-z][A-Za-z0-9_\\-]{0,31}", autocomplete: "off" });
    const select = h("input", { type: "text", placeholder: "sphere=0,1.4,0,0.3", autocomplete: "off" });
    const style = h("select"), freeze = h("input", { type: "checkbox" });
    const setStyles = (/** @type {string[]} */ names) => {
      const before = style.value;
      put(style, h("option", { value: "" }, say.ownStyle), names.map((each) => h("option", { value: each }, each)));
      style.value = names.includes(before) ? before : "";
    };
    setStyles(this.styles);
    const value = () => ({ name: name.value.trim(), ...(select.value.trim() ? { select: select.value.trim() } : {}), ...(style.value && !freeze.checked ? { style: style.value } : {}), ...(freeze.checked ? { freeze: true } : {}) });
    const element = h("fieldset.region", h("legend", say.region(this.rows.length + 1)), field("Name", name), field("Select", select), field(say.style, style), h("label.check", freeze, h("span", "Freeze")));
    const row = { element, value, setStyles };
    const remove = h("button.tool", { type: "button", "aria-label": say.remove(say.region(this.rows.length + 1)), onclick: () => ((this.rows = this.rows.filter((each) => each !== row)), element.remove()) }, icon("close"));
    element.append(remove);
    this.rows.push(row);
    this.list.append(element);
    name.focus();
  }

  /** @param {string[]} names names of the style files */
  setStyles(names) {
    this.styles = names;
    this.rows.forEach((row) => row.setStyles(names));
  }

  value() {
    return this.rows.map((row) => row.value()).filter((region) => region.name || region.select);
  }
}
