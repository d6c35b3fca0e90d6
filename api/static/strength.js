// @ts-check
/** Choice of the strength by pictures of one scene with each. */
import { h, newId } from "./dom.js";
import { words } from "./words.js";

/** @typedef {import("./options.js").Control} Control */

const say = words.strengths;
/** Content weight of each strength. @type {Record<string, number>} */
const WEIGHTS = /** @type {any} */ ("{{strengths}}");

/** Return the strength that a content weight is, or else the weight as text. @param {string | number} weight */
export const strengthName = (weight) => Object.keys(WEIGHTS).find((name) => WEIGHTS[name] === Number(weight)) ?? String(weight);

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
  const follow = () => inputs.forEach((input) => (input.checked = input.value === strengthName(control.value() ?? words.options.defaults.content_weight)));
  const pictures = inputs.map((input) => h("label", input, h("span", h("img", { src: new URL(`./strength/${input.value}.jpg`, import.meta.url).href, alt: "", loading: "lazy" }), h("strong", say.titles[input.value]))));
  control.element.prepend(h("fieldset.strengths", h("legend", say.legend), pictures));
  control.element.addEventListener("input", follow);
  follow();
  return follow;
}
