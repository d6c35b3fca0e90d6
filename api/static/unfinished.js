// @ts-check
/** Notice of an upload that was interrupted, in the form for a new job. */
import { h, put } from "./dom.js";
import { forgetUnfinished, unfinished } from "./uploads.js";
import { percent, size, words } from "./words.js";

const say = words.submit;

export class UnfinishedNotice {
  /** @param {() => import("./stored.js").Chosen[]} chosen returns the files of the form */
  constructor(chosen) {
    this.chosen = chosen;
    this.element = h("div.notice", { hidden: true });
  }

  show() {
    const chosen = this.chosen().filter((file) => file instanceof File);
    const isOf = (/** @type {File} */ file, /** @type {any} */ { size, modified }) => file.size === size && file.lastModified === modified;
    const first = unfinished().find((upload) => chosen.every((file) => file.name !== upload.name || isOf(file, upload)));
    this.element.hidden = !first;
    if (!first) return;
    const again = chosen.some(({ name }) => name === first.name), share = percent(first.sent / first.size);
    put(this.element, h("p", again ? say.resumed(first.name, share) : say.resumable(first.name, size(first.size), share)),
      h("button.quiet", { type: "button", onclick: () => (forgetUnfinished(), this.show()) }, say.forget));
  }
}
