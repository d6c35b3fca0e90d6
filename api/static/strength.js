// @ts-check
/** Choice of the strength by pictures of one scene with each. */
import { h, newId } from "./dom.js";
import { words } from "./words.js";

/** @typedef {import("./options.js").Control} Control */

const say = words.strengths;

/**
 * Add pictures to the input of the strength. Return a function that checks the picture of the input's value.
 *
 * @param {Control} control
 */
export function addPictures(control) {
  const name = newId();
  /** @type {HTMLInputElement[]} */
  const inputs = Object.keys(say.titles).map((value) => h("input", { type: "radio", name, value, onchange: () => {
    control.set(value);
    control.element.dispatchEvent(new Event("input", { bubbles: true }));
  } }));
  const follow = () => inputs.forEach((input) => (input.checked = input.value === (control.value() ?? words.options.defaults.content_weight)));
  const pictures = inputs.map((input) => h("label", input, h("span", h("img", { src: new URL(`./strength/${input.value}.jpg`, import.meta.url).href, alt: "", loading: "lazy" }), h("strong", say.titles[input.value]))));
  control.element.prepend(h("fieldset.strengths", h("legend", say.legend), pictures));
  control.element.addEventListener("input", follow);
  follow();
  return follow;
}
