// @ts-check
/** Presentation of a plan: predicted cost, what is skipped, and why. */
import { h } from "./dom.js";
import { count, seconds, size, words } from "./words.js";

const say = words.plan;

/** @param {any} view answer to a dry run */
export function costCard(view) {
  const figure = (/** @type {string} */ name, /** @type {string} */ value, note = "") => h("div", h("dt", name), h("dd", value, note && h("small", note)));
  return h("section.card.cost", { "aria-label": say.title }, h("h2", say.title),
    view.warnings.length ? h("ul.warnings", { role: "alert" }, view.warnings.map((/** @type {string} */ text) => h("li", text))) : null,
    h("dl.figures",
      figure(say.seconds, view.total_seconds === null ? say.unknown : seconds(view.total_seconds), view.total_seconds === null ? "" : say.wholeJob),
      figure(say.memory, view.memory_bytes === null ? say.unknown : size(view.memory_bytes)),
      view.device_memory_bytes ? figure(say.gpuMemory, size(view.device_memory_bytes)) : null,
      figure(say.workers, view.workers === null ? say.byService : String(view.workers)),
      figure(say.gaussians, count(view.gaussians), view.dropped ? say.dropped(view.dropped) : ""),
      figure(say.views, count(view.views), say.pixels(view.pixels))),
    decisions(view.plan?.decisions ?? []));
}

/** @param {{item: string, decision: string, reason: string}[]} list */
export function decisions(list) {
  if (!list.length) return h("p.quiet", say.none);
  return h("ul.decisions", { tabIndex: 0, "aria-label": say.decided }, list.map(({ item, decision, reason }) => h("li", h("strong", item), h("span", decision), h("small", reason))));
}
