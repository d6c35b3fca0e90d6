// @ts-check
/** Parts of a job's view: its name, progress, result, files, inputs, links for others, and video. */
import { artifactPath, ask, eventsOf, get, Problem } from "./api.js";
import { announce, h, icon, messageOf, put, tell } from "./dom.js";
import { tool } from "./fields.js";
import { titleOf, valueText } from "./options.js";
import { downloads, installed, statusTitles, UNFINISHED } from "./tables.js";
import { size, time, words } from "./words.js";

const say = words.job;

/** @param {string} id id of the job @param {number} bytes size of the PLY */
export function downloadCard(id, bytes) {
  const link = h("a.button.primary", { download: "" }, icon("down"), h("span", say.download)), note = h("p.help");
  const chooser = h("select", { "aria-label": say.format, onchange: () => choose() },
    downloads.map(({ name, title }, i) => h("option", { value: name }, i ? title : `${title} · ${size(bytes)}`)));
  const choose = () => {
    const path = artifactPath(id, "stylized.ply"), first = chooser.value === downloads[0].name;
    link.href = first ? path : `${path}?format=${encodeURIComponent(chooser.value)}`;
    note.textContent = first ? "" : say.converting;
  };
  choose();
  return [h("h2", say.result), h("div.row.download", link, chooser), note];
}

/** @param {string} id id of the job @param {any[]} list its artifacts */
export function filesCard(id, list) {
  const report = list.some(({ name }) => name === "report.html");
  return [h("h2", say.files), report ? h("p", h("a.button.quiet", { href: artifactPath(id, "report.html"), target: "_blank", rel: "noopener" }, say.openReport)) : null,
    list.length ? h("ul.files", list.map(({ name, size: bytes }) => h("li", h("a", { href: artifactPath(id, name), download: name }, icon("down"), h("span", name)), h("small", size(bytes))))) : h("p.quiet", say.noFiles)];
}

/** @param {any} job */
export function factsCard(job) {
  const told = Object.entries(job.parameters).filter(([name, value]) => value !== null && value !== "" && name !== "name" && value !== false);
  const files = Object.values(job.input_counts).reduce((sum, count) => sum + Number(count), 0);
  const fact = (/** @type {string} */ name, /** @type {string} */ value) => h("div", h("dt", name), h("dd", value));
  return [h("h2", say.inputs), h("dl.facts", job.inputs.slice(0, 12).map((/** @type {any} */ input) => fact(input.role, `${input.name} · ${size(input.size)}`)), files > Math.min(job.inputs.length, 12) ? fact("", words.submit.nFiles(files)) : null),
    h("details.fold", h("summary", say.settings), h("dl.facts", told.map(([name, value]) => fact(titleOf(name), valueText(name, value)))))];
}

export class JobName {
  /** @param {string} id @param {(job: any) => void} renamed @param {(error: unknown) => void} failed */
  constructor(id, renamed, failed) {
    this.id = id;
    this.renamed = renamed;
    this.failed = failed;
    this.name = "";
    this.heading = h("h1.name", say.unnamed);
    this.control = h("span.renaming");
  }

  /** @param {string} name @param {string} title the name, or a text for none */
  show(name, title) {
    this.name = name;
    this.heading.textContent = title;
    if (!this.control.firstChild) this.offer();
  }

  offer() {
    this.heading.hidden = false;
    put(this.control, tool("pen", say.rename, () => this.edit()));
  }

  /** Replace the heading by an input. Enter saves the name, Escape discards it. */
  edit() {
    const input = h("input", { type: "text", value: this.name, maxLength: 200, "aria-label": say.newName, autocomplete: "off" });
    const close = () => {
      this.offer();
      this.control.firstChild.focus();
    };
    input.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => event.key === "Escape" && close());
    const save = async (/** @type {Event} */ event) => {
      event.preventDefault();
      try {
        const job = await (await ask("PATCH", `v1/jobs/${this.id}`, { json: { name: input.value.trim() } })).json();
        close();
        this.renamed(job);
      } catch (error) {
        this.failed(error);
      }
    };
    this.heading.hidden = true;
    put(this.control, h("form", { onsubmit: save }, input, h("button.primary.small", { type: "submit" }, say.save), h("button.quiet.small", { type: "button", onclick: close }, say.keep)));
    input.focus();
    input.select();
  }
}

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
      this.text.textContent = job.status !== "queued" ? statusTitles[job.status] : job.queue_position === 1 ? say.next : job.queue_position ? say.queue(job.queue_position) : statusTitles.queued;
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

const DAYS = [1, 7, 30, 90];

export class ShareCard {
  /** @param {string} id id of the job */
  constructor(id) {
    this.path = `v1/jobs/${id}/shares`;
    this.days = h("select", { "aria-label": words.share.lifetime }, DAYS.map((days) => h("option", { value: days, selected: days === 7 }, words.share.days(days))));
    this.poster = h("input", { type: "checkbox" });
    this.link = h("div");
    /** Id of the share whose link is shown. */
    this.linked = "";
    this.list = h("ul.files");
    this.wrong = h("p.wrong", { hidden: true, role: "alert" });
    this.element = h("section.card.share", h("h2", words.share.title), h("p.help", words.share.help),
      h("div.row", h("button.quiet", { type: "button", onclick: () => this.act(() => this.create()) }, words.share.create), this.days), h("label.check", this.poster, h("span", words.share.poster)), this.link, this.list, this.wrong);
    this.act(() => this.show());
  }

  /** @param {() => Promise<void>} act */
  async act(act) {
    tell(this.wrong, "");
    await act().catch((error) => tell(this.wrong, messageOf(error)));
  }

  async create() {
    const { id, url, embed_url: frame } = await (await ask("POST", this.path, { json: { days: Number(this.days.value), poster: this.poster.checked } })).json();
    const at = (/** @type {string} */ path) => new URL(path.slice(path.lastIndexOf("/shared") + 1), location.href).href;
    const link = copied(words.share.link, at(url));
    this.linked = id;
    put(this.link, link, frame ? copied(words.share.frame, words.share.iframe(at(frame))) : null, h("p.help", words.share.once));
    link.querySelector("input")?.focus();
    await this.show();
  }

  async show() {
    const { shares } = await get(this.path);
    put(this.list, shares.map((/** @type {any} */ share) => h("li", h("span", words.share.until(time(share.expires_at))),
      h("button.quiet.small", { type: "button", "aria-label": words.share.revokeOf(time(share.expires_at)), onclick: () => this.act(() => this.revoke(share.id)) }, words.share.revoke))));
  }

  /** @param {string} id */
  async revoke(id) {
    await ask("DELETE", `${this.path}/${id}`);
    if (id === this.linked) put(this.link); // the link of another share is shown only once
    announce(words.share.revoked);
    await this.show();
  }
}

/** Return a text with a button that copies it. @param {string} name @param {string} value */
function copied(name, value) {
  const input = h("input", { type: "text", readOnly: true, value, "aria-label": name, title: name, onfocus: () => input.select() });
  return h("div.row", input, h("button.primary", { type: "button", title: name, onclick: () => copy(input) }, words.share.copy));
}

/** Copy the text of an input; without a secure context, browsers have no other way than the selection. @param {HTMLInputElement} input */
async function copy(input) {
  if (navigator.clipboard) await navigator.clipboard.writeText(input.value);
  else {
    input.select();
    document.execCommand("copy");
  }
  announce(words.share.copied);
}

export class VideoCard {
  /** @param {any} job @param {AbortSignal} signal aborted when the page leaves the job; its video is completed */
  constructor(job, signal) {
    this.job = job;
    this.shown = "";
    this.signal = signal;
    const cameras = job.inputs.some((/** @type {any} */ input) => input.role === "cameras");
    this.path = h("select", { "aria-label": words.video.path }, ["orbit", "cameras"].map((name) => h("option", { value: name, selected: cameras === (name === "cameras") }, words.video.paths[name])));
    this.seconds = h("select", { "aria-label": words.video.length }, [4, 8, 15, 30].map((n) => h("option", { value: n, selected: n === 8 }, words.video.seconds(n))));
    this.size = h("select", { "aria-label": words.video.size }, ["", 640, 1280, 1920].map((n) => h("option", { value: n }, words.video.pixels(n))));
    this.compare = h("input", { type: "checkbox" });
    this.button = h("button.quiet", { type: "submit" }, words.video.make);
    this.text = h("p.help", { role: "status" });
    this.bar = h("progress", { max: 1, value: 0, "aria-label": words.video.progress, hidden: true });
    this.failure = h("p.failure", { role: "alert", hidden: true });
    this.player = h("div", { hidden: true });
    const form = h("form", { hidden: !installed.video, onsubmit: (/** @type {Event} */ event) => (event.preventDefault(), this.make()) },
      h("div.row", this.path, this.seconds, this.size, h("label.check", this.compare, h("span", words.video.compare)), this.button));
    this.element = h("section.card.video", h("h2", words.video.title), this.player, form, this.text, this.bar, this.failure);
  }

  /** Show a video. @param {{sha256: string}} artifact */
  play({ sha256 }) {
    if (this.shown === sha256) return;
    this.shown = sha256;
    const path = artifactPath(this.job.id, "video.mp4");
    const note = h("p.help", { hidden: true }, words.video.unplayable);
    const video = h("video", { controls: true, loop: true, muted: true, playsInline: true, preload: "metadata", "aria-label": words.video.player, src: `${path}?made=${sha256.slice(0, 12)}`, onerror: () => (note.hidden = false) });
    this.player.hidden = false;
    put(this.player, video, note, h("p", h("a.button.quiet", { href: path, download: "" }, icon("down"), h("span", words.video.download))));
    this.button.textContent = words.video.again;
  }

  async make() {
    this.button.disabled = true;
    tell(this.failure, "");
    this.tell(words.video.starting);
    const json = { path: this.path.value, seconds: Number(this.seconds.value), resolution: Number(this.size.value) || null, compare: this.compare.checked };
    try {
      const answer = await ask("POST", `v1/jobs/${this.job.id}/video`, { json, headers: { Accept: "text/event-stream" }, signal: this.signal });
      for await (const { event, data } of eventsOf(answer)) {
        if (event === "rendering") this.tell(words.video.rendering(data.step, data.total, data.eta_s), data.fraction);
        else if (event === "problem") throw new Problem(data.status, data);
        else if (event === "video") this.play(data);
      }
      announce(words.video.made);
    } catch (error) {
      if (this.signal.aborted) return;
      tell(this.failure, messageOf(error));
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
