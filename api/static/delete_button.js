// @ts-check
/** Button that deletes a job after a confirmation. */
import { h, icon, put } from "./dom.js";
import { words } from "./words.js";

const say = words.job;

/**
 * Create a button that asks for confirmation.
 *
 * @param {string} name
 * @param {() => Promise<void>} act
 * @param {(error: unknown) => void} failed
 * @param {string} [label]
 */
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

