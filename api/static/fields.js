// @ts-check
/** Small controls of panels, and the button that deletes a job after a confirmation. */
import { h, icon, newId, put } from "./dom.js";
import { words } from "./words.js";

/** @param {string} name @param {() => void} onclick @param {string} [kind] */
export const button = (name, onclick, kind = "quiet") => h(`button.${kind}.small`, { type: "button", onclick }, name);

/** @param {Parameters<typeof icon>[0]} picture @param {string} name @param {() => void} onclick @param {Record<string, any>} [more] */
export const tool = (picture, name, onclick, more) => h("button.tool", { type: "button", title: name, "aria-label": name, onclick, ...more }, icon(picture));

/** @param {string} legend @param {Record<string, string>} names by value @param {(value: any) => void} changed */
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

const say = words.job;

/** @param {string} name @param {() => Promise<any>} act @param {(error: any) => void} failed @param {string} [label] */
export function deleteButton(name, act, failed, label) {
  const holder = h("span.sure");
  const first = h("button.quiet.danger", { type: "button", onclick: () => ask_(), "aria-label": label ?? name }, label ? icon("bin") : name);
  const ask_ = () => {
    const yes = h("button.danger", { type: "button", onclick: () => act().catch(failed) }, say.remove);
    holder.classList.add("asking");
    put(holder, h("span", say.removeSure), yes, h("button.quiet", { type: "button", onclick: leave }, say.keep));
    yes.focus();
  };
  const leave = () => {
    holder.classList.remove("asking");
    put(holder, first);
    first.focus();
  };
  holder.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => event.key === "Escape" && holder.classList.contains("asking") && leave());
  put(holder, first);
  return holder;
}
