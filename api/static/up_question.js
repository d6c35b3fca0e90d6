// @ts-check
/** Question which way is up in a scene that doesn't show it, with an image for each answer. */
import { h } from "./dom.js";
import { button } from "./fields.js";
import { UPS } from "./upright.js";
import { words } from "./words.js";

/** @typedef {import("./stage.js").Stage} Stage */

const say = words.upright;

/**
 * Create the question.
 *
 * @param {Stage} stage
 * @param {string[]} candidates values of the option `up`, the likeliest first
 * @param {(up: string) => void} choose receives the value that the user has chosen
 */
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
