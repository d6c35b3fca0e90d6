// @ts-check
/** View that compares two runs of one scene, on both sides of the wipe. */
import { get } from "./api.js";
import { h, put } from "./dom.js";
import { labels } from "./names.js";
import { ResultStage } from "./result_stage.js";
import { words } from "./words.js";

export class CompareView {
  /** @param {string[]} ids */
  constructor(ids) {
    this.title = words.compare.title;
    this.leaving = new AbortController();
    this.element = h("div.comparison", h("p.quiet.pending", words.page.loading));
    this.begin(ids);
  }

  /** @param {string[]} ids */
  async begin(ids) {
    try {
      const jobs = await Promise.all(ids.map((id) => get(`/v1/jobs/${id}`, this.leaving.signal)));
      if (jobs.some((job) => job.status !== "succeeded")) throw new Error(words.compare.notThere);
      this.stage = new ResultStage(jobs, { signal: this.leaving.signal });
      const names = labels(jobs);
      this.stage.stage.title = names.join(" ");
      put(this.element, h("header.head", h("h1", words.compare.heading(names[0], names[1])), h("div.row", jobs.map((job, i) => h("a.button.quiet", { href: `#/jobs/${job.id}` }, names[i])))), this.stage.element);
    } catch (error) {
      if (this.leaving.signal.aborted) return;
      put(this.element, h("div.empty", h("h1", words.page.error), h("p", error instanceof Error ? error.message : words.compare.notThere), h("a.button.quiet", { href: "#/jobs" }, words.page.jobs)));
    }
  }

  end() {
    this.leaving.abort();
    this.stage?.end();
  }
}
