// @ts-check
/**
 * View for entering an API key. The page never stores it: the service answers with a cookie that scripts cannot read.
 */
import { ask, Problem } from "./api.js";
import { h, newId } from "./dom.js";
import { words } from "./words.js";

const say = words.signIn;

export class SignInView {
  /** @param {() => void} done @param {string} why why a key is asked for */
  constructor(done, why) {
    this.title = say.title;
    const id = newId();
    this.input = h("input", { type: "password", id, autocomplete: "current-password", required: true, spellcheck: false, "aria-describedby": `${id}e` });
    this.wrong = h("p.wrong", { id: `${id}e`, hidden: true, role: "alert" });
    const form = h("form", { noValidate: true, onsubmit: (/** @type {Event} */ event) => (event.preventDefault(), this.send(done)) },
      h("div.option", h("label", { htmlFor: id }, say.key), this.input, this.wrong), h("button.primary", { type: "submit" }, say.go));
    this.element = h("div.empty.signin", h("h1", say.heading), h("p", why), h("p", say.where), form);
  }

  /** @param {() => void} done */
  async send(done) {
    this.wrong.hidden = true;
    try {
      await ask("POST", "v1/session", { json: { key: this.input.value.trim() } });
      this.input.value = "";
      done();
    } catch (error) {
      this.wrong.hidden = false;
      this.wrong.textContent = error instanceof Problem && error.status === 401 ? say.wrong : error instanceof Error ? error.message : String(error);
      this.input.focus();
    }
  }

  end() {}
}
