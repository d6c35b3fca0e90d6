// @ts-check
/** The page of a shared result: its viewer with the wipe, and nothing else. */
import { ask, get } from "./api.js";
import { h, put } from "./dom.js";
import { ResultStage } from "./result_stage.js";
import { time, words } from "./words.js";

const say = words.shared;
const main = h("main.shared", { id: "main", tabIndex: -1 }, h("p.quiet.pending", words.page.loading));
let leaving = new AbortController();
/** @type {ResultStage | null} */
let stage = null;

document.title = words.page.title(say.title);
document.body.append(h("header.top", h("span.brand", h("span.mark", { "aria-hidden": "true" }), words.page.name)), main, h("div.away", { id: "said", "aria-live": "polite" }));

/** Show the result whose token is in the address. Browsers do not send this part of an address with the page. */
async function show() {
  leaving.abort();
  leaving = new AbortController();
  stage?.end();
  const { signal } = leaving, at = `v1/shared/${encodeURIComponent(location.hash.slice(1))}`;
  try {
    const view = await get(at, signal);
    const job = { id: "shared", name: view.name, parameters: view.parameters, inputs: [{ role: "scene", sha256: "shared" }] };
    const cameras = () => Promise.all(view.cameras.map(async (/** @type {string} */ name, /** @type {number} */ i) => ({ name, blob: await (await ask("GET", `${at}/cameras:${i}`, { signal })).blob() })));
    stage = new ResultStage([job], { signal, blend: false, files: () => ({ scene: `${at}/scene`, result: (name) => `${at}/${name}`, cameras }) });
    stage.stage.title = view.name;
    document.title = words.page.title(view.name);
    put(main, h("header.head", h("div", h("h1.name", view.name), h("p.meta", say.until(time(view.expires_at))))), stage.element);
  } catch (error) {
    if (!signal.aborted) put(main, h("div.empty", h("h1", say.gone), h("p", error instanceof Error ? error.message : String(error))));
  }
}

addEventListener("hashchange", show);
show();
