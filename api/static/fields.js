// @ts-check
/** Small controls of panels. */
import { h, newId } from "./dom.js";

/** @param {string} name @param {() => void} onclick @param {string} [kind] */
export const button = (name, onclick, kind = "quiet") => h(`button.${kind}.small`, { type: "button", onclick }, name);

/**
 * Create buttons of which one is pressed, the first one at the start.
 *
 * @param {string} legend
 * @param {Record<string, string>} names titles by value
 * @param {(value: any) => void} changed
 */
export function radios(legend, names, changed) {
  const group = newId();
  return h("fieldset.segments", h("legend.away", legend), Object.entries(names).map(([value, name], i) => h("label", h("input", { type: "radio", name: group, value, checked: i === 0, onchange: () => changed(value) }), h("span", name))));
}

/** @param {string} name @param {any} properties */
export function range(name, properties) {
  const input = h("input", { type: "range", id: newId(), ...properties });
  return { input, element: h("div.range", h("label", { htmlFor: input.id }, name), input) };
}

/** @param {string} name */
export function check(name, checked = false) {
  const input = h("input", { type: "checkbox", checked });
  return { input, element: h("label.check", input, h("span", name)) };
}
