// @ts-check
/** Card of a finished job that plays the video of its result, and has the service make one. */
import { artifactPath, ask, eventsOf, Problem } from "./api.js";
import { announce, h, icon, put } from "./dom.js";
import { installed } from "./installed.js";
import { words } from "./words.js";

const say = words.video;

export class VideoCard {
  /**
   * @param {any} job
   * @param {AbortSignal} signal aborted when the page leaves the job; the service completes the video nevertheless
   */
  constructor(job, signal) {
    this.job = job;
    this.shown = "";
    this.signal = signal;
    const cameras = job.inputs.some((/** @type {any} */ input) => input.role === "cameras");
    this.path = h("select", { "aria-label": say.path }, ["orbit", "cameras"].map((name) => h("option", { value: name, selected: cameras === (name === "cameras") }, say.paths[name])));
    this.seconds = h("select", { "aria-label": say.length }, [4, 8, 15, 30].map((n) => h("option", { value: n, selected: n === 8 }, say.seconds(n))));
    this.size = h("select", { "aria-label": say.size }, ["", 640, 1280, 1920].map((n) => h("option", { value: n }, say.pixels(n))));
    this.compare = h("input", { type: "checkbox" });
    this.button = h("button.quiet", { type: "submit" }, say.make);
    this.text = h("p.help", { role: "status" });
    this.bar = h("progress", { max: 1, value: 0, "aria-label": say.progress, hidden: true });
    this.failure = h("p.failure", { role: "alert", hidden: true });
    this.player = h("div", { hidden: true });
    const form = h("form", { hidden: !installed.video, onsubmit: (/** @type {Event} */ event) => (event.preventDefault(), this.make()) },
      h("div.row", this.path, this.seconds, this.size, h("label.check", this.compare, h("span", say.compare)), this.button));
    this.element = h("section.card.video", h("h2", say.title), this.player, form, this.text, this.bar, this.failure);
  }

  /** Show a video. @param {{sha256: string}} artifact */
  play({ sha256 }) {
    if (this.shown === sha256) return;
    this.shown = sha256;
    const path = artifactPath(this.job.id, "video.mp4");
    const note = h("p.help", { hidden: true }, say.unplayable);
    const video = h("video", { controls: true, loop: true, muted: true, playsInline: true, preload: "metadata", "aria-label": say.player, src: `${path}?made=${sha256.slice(0, 12)}`, onerror: () => (note.hidden = false) });
    this.player.hidden = false;
    put(this.player, video, note, h("p", h("a.button.quiet", { href: path, download: "" }, icon("down"), h("span", say.download))));
    this.button.textContent = say.again;
  }

  async make() {
    this.button.disabled = true;
    this.failure.hidden = true;
    this.tell(say.starting);
    const json = { path: this.path.value, seconds: Number(this.seconds.value), resolution: Number(this.size.value) || null, compare: this.compare.checked };
    try {
      const answer = await ask("POST", `v1/jobs/${this.job.id}/video`, { json, headers: { Accept: "text/event-stream" }, signal: this.signal });
      for await (const { event, data } of eventsOf(answer)) {
        if (event === "rendering") this.tell(say.rendering(data.step, data.total, data.eta_s), data.fraction);
        else if (event === "problem") throw new Problem(data.status, data);
        else if (event === "video") this.play(data);
      }
      announce(say.made);
    } catch (error) {
      if (this.signal.aborted) return;
      this.failure.hidden = false;
      this.failure.textContent = error instanceof Error ? error.message : String(error);
    }
    this.button.disabled = false;
    this.text.textContent = "";
    this.bar.hidden = true;
  }

  /** @param {string} text @param {number} [fraction] */
  tell(text, fraction) {
    this.text.textContent = text;
    this.bar.hidden = false;
    if (fraction === undefined) this.bar.removeAttribute("value");
    else this.bar.value = fraction;
  }
}
