// @ts-check
/** The page of a shared result: its viewer with the wipe, and nothing else. In a frame (`embed=1`), the scene rotates. */
import { ask, get } from "./api.js";
import { h, messageOf, put } from "./dom.js";
import { ResultStage } from "./result_stage.js";
import { time, words } from "./words.js";

const say = words.shared;
const main = h("main.shared", { id: "main", tabIndex: -1 }, h("p.quiet.pending", words.page.loading));
let leaving = new AbortController();
/** @type {ResultStage | null} */
let stage = null;
/** Token in the path, if it is there rather than behind #. Browsers do not send that part of an address with the page. */
const inPath = location.pathname.match(/\/shared\/([^/]+)$/)?.[1];
const embedded = new URLSearchParams(location.search).get("embed") === "1";

document.title = words.page.title(say.title);
document.body.classList.toggle("embed", embedded);
document.body.append(h("header.top", h("span.brand", h("span.mark", { "aria-hidden": "true" }), words.page.name)), main, h("div.away", { id: "said", "aria-live": "polite" }));

/** Show the result whose token is in the address. */
async function show() {
  leaving.abort();
  leaving = new AbortController();
  stage?.end();
  const { signal } = leaving, at = inPath ? `../v1/shared/${inPath}` : `v1/shared/${encodeURIComponent(location.hash.slice(1))}`;
  try {
    const view = await get(at, signal);
    const job = { id: "shared", name: view.name, parameters: view.parameters, viewpoints: view.viewpoints, inputs: [{ role: "scene", sha256: "shared" }] };
    const cameras = () => Promise.all(view.cameras.map(async (/** @type {string} */ name, /** @type {number} */ i) => ({ name, blob: await (await ask("GET", `${at}/cameras:${i}`, { signal })).blob() })));
    stage = new ResultStage([job], { signal, blend: false, files: () => ({ scene: `${at}/scene`, result: (name) => `${at}/${name}`, cameras }) });
    stage.stage.title = view.name;
    document.title = words.page.title(view.name);
    put(main, embedded ? null : h("header.head", h("div", h("h1.name", view.name), h("p.meta", say.until(time(view.expires_at))))), stage.element);
    if (embedded) present(stage, view.files.includes("poster") ? `${at}/poster` : "", signal).catch(() => {}); // the stage says what is wrong
  } catch (error) {
    if (!signal.aborted) put(main, h("div.empty", h("h1", say.gone), h("p", messageOf(error))));
  }
}

/**
 * Show the image of a result until the whole scene is there, then rotate the scene until it is touched.
 *
 * @param {ResultStage} result
 * @param {string} poster address of the image; "" for none
 * @param {AbortSignal} signal
 */
async function present({ stage, loading }, poster, signal) {
  const image = poster ? h("img.poster", { src: poster, alt: "" }) : null;
  if (image) stage.canvas.after(image);
  await loading;
  await stage.viewer?.sides?.left.scene.ready;
  image?.remove();
  const motion = stage.controls?.motion;
  if (!motion || signal.aborted) return;
  motion.spin();
  for (const kind of ["pointerdown", "wheel", "keydown"]) addEventListener(kind, () => motion.spinning && motion.stop(), { signal, capture: true, passive: true });
}

addEventListener("hashchange", show);
show();
