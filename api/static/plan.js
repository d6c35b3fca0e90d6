// @ts-check
/** Presentation of a plan: predicted cost, what is skipped, and why. */
import { h } from "./dom.js";
import { count, seconds, size, words } from "./words.js";

const say = words.plan;

/** Seconds above which something faster is offered. */
const LONG = 3600;

/** @param {any} view answer to a dry run @param {(() => void) | null} [hurry] prefers a time budget to a long job */
export function costCard(view, hurry = null) {
  const figure = (/** @type {string} */ name, /** @type {string} */ value, note = "") => h("div", h("dt", name), h("dd", value, note && h("small", note)));
  return h("section.card.cost", { "aria-label": say.title }, h("h2", say.title),
    warnings(view.warnings),
    h("dl.figures",
      figure(say.seconds, view.total_seconds === null ? say.unknown : seconds(view.total_seconds), view.total_seconds === null ? "" : say.wholeJob),
      figure(say.memory, view.memory_bytes === null ? say.unknown : size(view.memory_bytes)),
      view.device_memory_bytes ? figure(say.gpuMemory, size(view.device_memory_bytes)) : null,
      view.workers === null ? null : figure(say.workers, String(view.workers)),
      figure(say.gaussians, count(view.gaussians), view.dropped ? say.dropped(view.dropped) : ""),
      figure(say.views, count(view.views), say.pixels(view.pixels))),
    hurry && view.total_seconds > LONG ? h("div.row.faster", h("span", say.long), h("button.primary.small", { type: "button", onclick: hurry }, say.faster)) : null,
    h("details.fold", h("summary", say.decided), decisions(view.plan?.decisions ?? [])));
}

/** @param {string[]} texts */
const warnings = (texts) => (texts.length ? h("ul.warnings", { role: "alert" }, texts.map((text) => h("li", text))) : null);

/** @typedef {{item: string, decision: string, reason: string}} Decision */

/** @param {Decision[]} list */
function decisions(list) {
  if (!list.length) return h("p.quiet", say.none);
  return h("ul.decisions", { tabIndex: 0, "aria-label": say.decided }, list.map(({ item, decision, reason }) => h("li", h("strong", say.items[item] ?? item), h("span", decision), h("small", reason))));
}

/** Return a plan: its warnings, and the rest folded away. @param {HTMLElement} title @param {Decision[]} list */
export function planOf(title, list) {
  const warned = list.filter(({ decision }) => decision.startsWith("warning")).map(({ item, decision }) => `${item}: ${decision.replace(/^warning:? ?/, "")}`);
  return [warnings(warned), h("details", h("summary", title), decisions(list))];
}
