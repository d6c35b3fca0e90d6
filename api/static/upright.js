// @ts-check
/** The up direction of a scene: buttons that turn one which lies on its side, and a question with an image for each answer. */
import { h } from "./dom.js";
import { button, tool } from "./fields.js";
import { cross, dot, times } from "./viewer/vectors.js";
import { words } from "./words.js";

/** @typedef {import("./viewer/vectors.js").Vector} Vector */
/** @typedef {import("./stage.js").Stage} Stage */

const say = words.upright;
/** Directions that the option `up` offers. */
export const UPS = /** @type {Record<string, Vector>} */ ({ x: [1, 0, 0], "-x": [-1, 0, 0], y: [0, 1, 0], "-y": [0, -1, 0], z: [0, 0, 1], "-z": [0, 0, -1] });

/** Return a direction such as "-y" or "(0.00, 0.60, 0.80)"; undefined for "auto". @param {string} [text] @returns {Vector | undefined} */
export function directionOf(text = "") {
  const numbers = text.match(/-?\d[\d.]*/g)?.map(Number);
  return UPS[text] ?? (numbers?.length === 3 ? numbers : undefined);
}

/** Return the value of the option `up` for a direction; undefined if there is none. @param {Vector} up */
export const upName = (up) => Object.keys(UPS).find((name) => dot(UPS[name], up) > 0.999);

/** Return the axis nearest to a direction, of those across. @param {Vector} up @param {Vector} wanted */
function turnedUp(up, wanted) {
  const across = Object.entries(UPS).filter(([, axis]) => Math.abs(dot(axis, up)) < 0.5);
  return across.reduce((best, each) => (dot(each[1], wanted) > dot(best[1], wanted) ? each : best))[0];
}

/** @param {Stage} stage @param {(up: string, front: Vector) => void} choose receives `up` and where to look from */
export function uprightButtons(stage, choose) {
  const turning = (/** @type {"turn" | "tip"} */ name, /** @type {(up: Vector, ahead: Vector) => [Vector, Vector]} */ turned) => tool(name, say[name], () => {
    if (!stage.viewer?.sides) return;
    const { up, axes: [, , forward] } = stage.viewer.camera, [wanted, front] = turned(up, UPS[turnedUp(up, forward)]);
    choose(turnedUp(up, wanted), front);
  });
  return h("div.upright", turning("turn", (up, ahead) => [cross(up, ahead), times(ahead, -1)]), turning("tip", (up, ahead) => [ahead, up]));
}

/** @param {Stage} stage @param {string[]} candidates likeliest `up` first @param {(up: string) => void} choose */
export function upQuestion(stage, candidates, choose) {
  const others = Object.keys(UPS).filter((up) => !candidates.includes(up));
  const shown = !!stage.viewer?.sides?.left.scene.middle;
  const answers = candidates.map((up) => ({ up, image: h("img", { alt: "", hidden: !shown }) }));
  const neither = button(say.neither, () => element.replaceWith(upQuestion(stage, others, choose)));
  const element = h("section.card.up-question", { "aria-label": say.which }, h("h2", say.which), h("p.help", say.unsure),
    h("div.answers", answers.map(({ up, image }) => h("button", { type: "button", onclick: () => choose(up) }, image, h("span", say.isUp(up))))),
    others.length > candidates.length ? h("div.row", neither) : null);
  addImages(stage, answers, () => element.isConnected);
  return element;
}

/**
 * Draw the scene upright for each answer; without a 3D view, the answers stay without images.
 *
 * @param {Stage} stage
 * @param {{up: string, image: HTMLImageElement}[]} answers
 * @param {() => boolean} asking whether the question is still shown
 */
async function addImages(stage, answers, asking) {
  const { viewer } = stage;
  if (!viewer?.sides?.left.scene.middle) return;
  const frame = () => new Promise(requestAnimationFrame);
  await frame(); // the question is shown by then
  viewer.lines = new Float32Array(0);
  for (const { up, image } of answers) {
    viewer.frame(UPS[up]);
    viewer.draw();
    while (asking() && viewer.canvas.dataset.state !== "settled") await frame();
    if (!asking()) break;
    image.src = URL.createObjectURL(await viewer.picturePng());
    image.onload = () => URL.revokeObjectURL(image.src);
  }
  stage.home();
  stage.drawFrames();
}
