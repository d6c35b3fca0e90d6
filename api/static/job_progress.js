// @ts-check
/** State of a running job, its stage, steps and remaining time, and how it ended. */
import { h } from "./dom.js";
import { titles, UNFINISHED } from "./statuses.js";
import { words } from "./words.js";

const say = words.job;
/** Stages before the steps. */
const PLANNING = new Set(["planning", "refining"]);

/** Describe how a job ended; empty if it made all steps and its loss fell. @param {any} result */
export function outcomeOf(result) {
  const { stopped, steps, total, loss_before: before, loss_after: after } = result ?? {}, risen = after > before;
  const early = steps < total ? say.early[stopped] : undefined;
  if (!early) return risen ? say.risen : "";
  const made = [say.steps(steps, total), before > 0 && say.lossLeft(after / before)].filter(Boolean).join(", ");
  return `${early}: ${made}. ${say.onward[stopped] ?? (risen ? say.risen : "")}`.trim();
}

export class JobProgress {
  constructor() {
    this.text = h("span");
    this.left = h("span.left");
    this.bar = h("progress", { max: 1, value: 0, "aria-label": say.progress });
    this.element = h("div.state", h("div.row", this.text, this.left), this.bar);
  }

  /** @param {any} job */
  show(job) {
    const { progress } = job;
    this.element.hidden = !UNFINISHED.has(job.status);
    if (this.element.hidden) return;
    if (job.status === "queued" || !progress) {
      this.text.textContent = job.status !== "queued" ? titles[job.status] : job.queue_position === 1 ? say.next : job.queue_position ? say.queue(job.queue_position) : titles.queued;
      this.left.textContent = "";
      this.bar.removeAttribute("value");
      return;
    }
    const { stage, eta_s } = progress, planning = PLANNING.has(stage), checking = stage === "measuring";
    const [done, total] = checking ? [progress.views_checked ?? 0, progress.views_to_check ?? 0] : [progress.step, progress.total];
    this.text.textContent = [say.stages[stage] ?? stage, total ? (stage === "video" ? say.frame : planning || checking ? say.view : say.step)(done, total) : ""].filter(Boolean).join(" · ");
    // before the first step, the time of the steps is unknown
    this.left.textContent = eta_s === null || eta_s === undefined || planning ? "" : say.left(eta_s);
    if (total) this.bar.value = done / total;
    else this.bar.removeAttribute("value");
  }
}
