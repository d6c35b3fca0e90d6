// @ts-check
/** Paintings to choose from: those of the caller's last jobs, and some that come with the page. */
import { get } from "./api.js";
import { h, put } from "./dom.js";
import { storedInputs } from "./stored.js";
import { words } from "./words.js";

/** @typedef {import("./stored.js").Chosen} Chosen */

const say = words.gallery;
/** Number of paintings of earlier jobs. */
const MOST_USED = 6;

export class Gallery {
  /**
   * @param {(painting: Chosen) => void} choose
   * @param {AbortSignal} signal
   * @param {HTMLElement} example offer of an example scene
   */
  constructor(choose, signal, example) {
    this.choose = choose;
    this.signal = signal;
    this.used = h("div", { hidden: true });
    const bundled = Object.entries(say.paintings).map(([name, title]) => this.painting(address(name), title, () => painting(name)));
    this.element = h("details.fold.gallery", { ontoggle: () => this.loadUsed() }, h("summary", say.title), example, this.used, h("p.help", say.bundled), h("div.paintings", bundled));
  }

  /** @param {string} url @param {string} title @param {() => Chosen | Promise<Chosen>} take */
  painting(url, title, take) {
    return h("button.painting", { type: "button", title, "aria-label": say.use(title), onclick: async () => this.choose(await take()) },
      h("img", { src: url, alt: "", loading: "lazy", decoding: "async" }));
  }

  /** Show the paintings of the last jobs. Jobs that have expired have none. */
  async loadUsed() {
    if (!this.element.open || this.loaded) return;
    this.loaded = true;
    const { jobs } = await get("v1/jobs?limit=60", this.signal).catch(() => ({ jobs: [] })), found = new Map();
    for (const job of jobs) {
      if (job.status !== "expired") for (const painting of storedInputs(job).style) if (!found.has(painting.sha256)) found.set(painting.sha256, painting);
    }
    const shown = [...found.values()].slice(0, MOST_USED);
    this.used.hidden = !shown.length;
    put(this.used, h("p.help", say.used), h("div.paintings", shown.map((painting) => this.painting(painting.url, painting.name, () => painting))));
  }
}

/** @param {string} name */
const address = (name) => new URL(`./paintings/${name}.jpg`, import.meta.url).href;

/** Return a file of the page as if it were chosen from this device. @param {string} url @param {string} name */
export async function fetched(url, name) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(words.api.status(answer.status));
  const blob = await answer.blob();
  return new File([blob], name, { type: blob.type, lastModified: 0 }); // the same upload every time
}

/** Return a painting of the page. @param {string} name */
export const painting = (name) => fetched(address(name), `${name}.jpg`);
