// @ts-check
/** The page of an exported scene. The same file holds its modules and its data; `worker/derived.py` writes it. */
import { Blend } from "./blend.js";
import { h } from "./dom.js";
import { Stage } from "./stage.js";
import { FRONT } from "./viewer/splat_scene.js";
import { ViewpointsPanel } from "./viewpoints.js";
import { words } from "./words.js";

/**
 * @typedef {object} Exported
 * @property {string} title
 * @property {number[]} up up direction of the scene
 * @property {number} fade fraction by which the stylized scene's harmonics are smaller
 * @property {boolean} sog whether the scene was a SOG before the export
 * @property {number[]} background color behind the scene, in 0..1
 * @property {import("./viewpoints.js").Viewpoints} viewpoints
 * @property {File} scene scene as SOG: the original if there is one, else the stylized one
 * @property {Uint8Array | null} colors of the stylized scene: 256 values as halves, then 3 indices for each Gaussian; null
 *   without an original
 */

const { title, up, fade, sog, background, viewpoints, scene: file, colors } = /** @type {Exported} */ (/** @type {any} */ (globalThis).exported);
const stage = new Stage();
stage.up = up;
stage.title = title;
const blend = new Blend([{ id: "stylized" }], [words.viewer.stylized], show, false);
blend.element.hidden = !colors || fade > 0;
document.body.append(h("header.top", h("span.brand", h("span.mark", { "aria-hidden": "true" }), title)),
  h("main.shared", { id: "main", tabIndex: -1 }, h("div.result-stage", stage.element, new ViewpointsPanel(stage, viewpoints).element, blend.element)), h("div.away", { id: "said", "aria-live": "polite" }));

const scene = stage.viewer?.open(file);
if (stage.viewer && scene) {
  stage.viewer.background = background;
  if (!sog) scene.headerRead.then(() => void (scene.front = FRONT), () => {});
  stage.show({ scene, colors: "own" });
  stage.open();
  scene.ready.then(() => stage.open(), (error) => stage.message(error.message));
  if (colors) {
    stage.original = { scene, colors: "own" };
    scene.addColors("stylized", new Blob([halves(colors)]).stream()).then(show);
  }
}

/** Show the original, and the stylized scene or the blend, on the sides of the wipe. */
function show() {
  if (!scene) return;
  const stylized = { scene, colors: "stylized", fade, blend: fade > 0 ? undefined : blend.parts };
  stage.show({ scene, colors: "own" }, stylized, [words.viewer.original, blend.name]);
}

/** Return three halves for each Gaussian. @param {Uint8Array} indexed */
function halves(indexed) {
  const values = new Uint16Array(indexed.slice(0, 512).buffer);
  return Uint16Array.from(indexed.subarray(512), (index) => values[index]);
}
