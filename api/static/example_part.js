// @ts-check
/** Example for users who have no scene at hand: the demo's scene, with cameras and a painting. */
import { h } from "./dom.js";
import { fetched, painting } from "./gallery.js";
import { words } from "./words.js";

const say = words.example;
/** Name of the example's scene. */
export const EXAMPLE = "motorcycle.sog";

export class ExamplePart {
  /** @param {() => void} start called when a user wants the example */
  constructor(start) {
    this.buttons = [start, start].map((onclick) => h("button.quiet", { type: "button", onclick }, say.start));
    /** The same offer for two places. @type {HTMLElement[]} */
    this.offers = this.buttons.map((button) => h("div.example", button, h("small", say.credit)));
  }

  /** Return the files of the example by role. */
  async files() {
    for (const button of this.buttons) button.textContent = say.preparing;
    try {
      const parts = [EXAMPLE, "cameras.json"].map((name) => fetched(new URL(`./example/${name}`, import.meta.url).href, name));
      const [scene, cameras, style] = await Promise.all([...parts, painting("starry_night")]);
      return { scene: [scene], style: [style], cameras: [cameras] };
    } finally {
      for (const button of this.buttons) button.textContent = say.start;
    }
  }
}
