// @ts-check
/** Card of a job's page that creates, lists and revokes read-only links to the result. */
import { ask, get } from "./api.js";
import { announce, h, put } from "./dom.js";
import { time, words } from "./words.js";

const say = words.share;
const DAYS = [1, 7, 30, 90];

export class ShareCard {
  /** @param {string} id id of the job */
  constructor(id) {
    this.path = `v1/jobs/${id}/shares`;
    this.days = h("select", { "aria-label": say.lifetime }, DAYS.map((days) => h("option", { value: days, selected: days === 7 }, say.days(days))));
    this.poster = h("input", { type: "checkbox" });
    this.link = h("div");
    /** Id of the share whose link is shown. */
    this.linked = "";
    this.list = h("ul.files");
    this.wrong = h("p.wrong", { hidden: true, role: "alert" });
    this.element = h("section.card.share", h("h2", say.title), h("p.help", say.help),
      h("div.row", h("button.quiet", { type: "button", onclick: () => this.act(() => this.create()) }, say.create), this.days), h("label.check", this.poster, h("span", say.poster)), this.link, this.list, this.wrong);
    this.act(() => this.show());
  }

  /** @param {() => Promise<void>} act */
  async act(act) {
    this.wrong.hidden = true;
    try {
      await act();
    } catch (error) {
      this.wrong.hidden = false;
      this.wrong.textContent = error instanceof Error ? error.message : String(error);
    }
  }

  async create() {
    const { id, url, embed_url: frame } = await (await ask("POST", this.path, { json: { days: Number(this.days.value), poster: this.poster.checked } })).json();
    const at = (/** @type {string} */ path) => new URL(path.slice(path.lastIndexOf("/shared") + 1), location.href).href;
    const link = copied(say.link, at(url));
    this.linked = id;
    put(this.link, link, frame ? copied(say.frame, say.iframe(at(frame))) : null, h("p.help", say.once));
    link.querySelector("input")?.focus();
    await this.show();
  }

  async show() {
    const { shares } = await get(this.path);
    put(this.list, shares.map((/** @type {any} */ share) => h("li", h("span", say.until(time(share.expires_at))),
      h("button.quiet.small", { type: "button", "aria-label": say.revokeOf(time(share.expires_at)), onclick: () => this.act(() => this.revoke(share.id)) }, say.revoke))));
  }

  /** @param {string} id */
  async revoke(id) {
    await ask("DELETE", `${this.path}/${id}`);
    if (id === this.linked) put(this.link); // the link of another share is shown only once
    announce(say.revoked);
    await this.show();
  }
}

/** Return a text with a button that copies it. @param {string} name @param {string} value */
function copied(name, value) {
  const input = h("input", { type: "text", readOnly: true, value, "aria-label": name, title: name, onfocus: () => input.select() });
  return h("div.row", input, h("button.primary", { type: "button", title: name, onclick: () => copy(input) }, say.copy));
}

/** Copy the text of an input; without a secure context, browsers have no other way than the selection. @param {HTMLInputElement} input */
async function copy(input) {
  if (navigator.clipboard) await navigator.clipboard.writeText(input.value);
  else {
    input.select();
    document.execCommand("copy");
  }
  announce(say.copied);
}
