// @ts-check
/** The page: its frame, its views by address, and the session, whose cookie scripts cannot read. No key is stored. */
import { ask, get, KEY_NEEDED, Problem } from "./api.js";
import { CompareView, JobsView } from "./jobs.js";
import { announce, h, icon, messageOf, newId, put, tell } from "./dom.js";
import { JobView } from "./job.js";
import { forgetDraft, keptDraft } from "./stored.js";
import { SubmitView } from "./submit.js";
import { words } from "./words.js";

/** @typedef {{title: string, element: HTMLElement, end: () => void, handOver?: (id: string) => import("./stage.js").Stage | undefined}} View `handOver`: gives its 3D view to that of a job */

const say = words.page;
const main = h("main", { id: "main", tabIndex: -1 });
const links = [["#/", say.new], ["#/jobs", say.jobs]].map(([href, text]) => h("a", { href, onclick: () => href === "#/" && renew() }, text));
const out = h("button.tool.wide", { type: "button", hidden: true, onclick: signOut }, icon("out"), h("span", say.signOut));
/** @type {View | null} */
let view = null;

document.body.append(
  h("a.skip", { href: "#main", onclick: (/** @type {Event} */ event) => (event.preventDefault(), main.focus()) }, say.skip),
  h("header.top", h("a.brand", { href: "#/" }, h("span.mark", { "aria-hidden": "true" }), say.name), h("nav", { "aria-label": say.main }, links), h("span.grow"), h("a.faint", { href: "docs" }, say.api), out),
  main,
  h("div.away", { id: "said", "aria-live": "polite" }),
);

/** @returns {View} */
function viewOf() {
  const [, name = "", ...ids] = location.hash.split("/");
  const known = ids.length > 0 && ids.every((id) => /^job_[0-9a-f]+$/.test(id));
  if (name === "") return new SubmitView();
  if (name === "jobs" && !ids.length) return new JobsView();
  if (name === "jobs" && known && ids.length === 1) return new JobView(ids[0], view?.handOver?.(ids[0]));
  if (name === "compare" && known && ids.length >= 2 && ids.length <= 20) return new CompareView(ids);
  return { title: "", element: h("div.empty", h("h1", say.missing), h("a.button.primary", { href: "#/" }, say.toNew)), end: () => {} };
}

/** @param {View} next */
function show(next) {
  view?.end();
  view = next;
  put(main, next.element);
  document.title = say.title(next.title);
  const here = /^#\/(jobs|compare)/.test(location.hash) ? "#/jobs" : "#/";
  for (const link of links) link.toggleAttribute("aria-current", link.getAttribute("href") === here);
  for (const link of links) if (link.hasAttribute("aria-current")) link.setAttribute("aria-current", "page");
}

function enter() {
  show(viewOf());
  scrollTo(0, 0);
}

/** Forget what an earlier job has filled into the form: "New" is new. */
function renew() {
  if (!keptDraft()?.again) return;
  view?.end();
  view = null;
  forgetDraft();
  if (location.hash === "#/") enter(); // else the address changes
}

async function signOut() {
  await ask("DELETE", "v1/session").catch(() => {});
  announce(words.signIn.out);
  signIn(words.signIn.out);
  forgetDraft(); // the next person at this computer must not see it
}

/** @param {string} [why] why a key is asked for */
function signIn(why = out.hidden ? words.signIn.lead : words.signIn.expired) {
  if (view instanceof SignInView) return;
  out.hidden = true;
  show(new SignInView(begin, why));
}

async function begin() {
  const session = await get("v1/session").catch(() => ({ keys_needed: false, signed_in: false }));
  out.hidden = !session.signed_in;
  if (session.keys_needed && !session.signed_in) signIn();
  else enter();
}

addEventListener(KEY_NEEDED, () => signIn());
addEventListener("hashchange", () => {
  if (view instanceof SignInView) return;
  enter();
  main.focus({ preventScroll: true });
  announce(view?.title ?? "");
});
begin();

class SignInView {
  /** @param {() => void} done @param {string} why why a key is asked for */
  constructor(done, why) {
    this.title = words.signIn.title;
    const id = newId();
    this.input = h("input", { type: "password", id, autocomplete: "current-password", required: true, spellcheck: false, "aria-describedby": `${id}e` });
    this.wrong = h("p.wrong", { id: `${id}e`, hidden: true, role: "alert" });
    const form = h("form", { noValidate: true, onsubmit: (/** @type {Event} */ event) => (event.preventDefault(), this.send(done)) },
      h("div.option", h("label", { htmlFor: id }, words.signIn.key), this.input, this.wrong), h("button.primary", { type: "submit" }, words.signIn.go));
    this.element = h("div.empty.signin", h("h1", words.signIn.heading), h("p", why), h("p", words.signIn.where), form);
  }

  /** @param {() => void} done */
  async send(done) {
    tell(this.wrong, "");
    try {
      await ask("POST", "v1/session", { json: { key: this.input.value.trim() } });
      this.input.value = "";
      done();
    } catch (error) {
      tell(this.wrong, error instanceof Problem && error.status === 401 ? words.signIn.wrong : messageOf(error));
      this.input.focus();
    }
  }

  end() {}
}
