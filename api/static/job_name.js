// @ts-check
/** Heading of a job's view: its name, which can be changed. */
import { ask } from "./api.js";
import { h, icon, put } from "./dom.js";
import { words } from "./words.js";

const say = words.job;

export class JobName {
  /**
   * @param {string} id id of the job
   * @param {(job: any) => void} renamed receives the job after it was renamed
   * @param {(error: unknown) => void} failed
   */
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
    put(this.control, h("button.tool", { type: "button", title: say.rename, "aria-label": say.rename, onclick: () => this.edit() }, icon("pen")));
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
