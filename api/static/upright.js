// @ts-check
/** Buttons of the form's 3D view that turn a scene which lies on its side: they choose the job's up direction. */
import { h, icon } from "./dom.js";
import { cross, dot, times } from "./viewer/vectors.js";
import { words } from "./words.js";

/** @typedef {import("./viewer/vectors.js").Vector} Vector */

const say = words.upright;
/** Directions that the option `up` offers. */
export const UPS = /** @type {Record<string, Vector>} */ ({ x: [1, 0, 0], "-x": [-1, 0, 0], y: [0, 1, 0], "-y": [0, -1, 0], z: [0, 0, 1], "-z": [0, 0, -1] });

/** Return a direction such as "-y" or "(0.00, 0.60, 0.80)"; undefined for "auto". @param {string} [text] @returns {Vector | undefined} */
export function directionOf(text = "") {
  const numbers = text.match(/-?\d[\d.]*/g)?.map(Number);
  return UPS[text] ?? (numbers?.length === 3 ? numbers : undefined);
}

/**
 * Return the up direction after a quarter turn.
 *
 * @param {Vector} up up direction before
 * @param {Vector} wanted direction that becomes up, as nearly as the axes allow
 */
export function turnedUp(up, wanted) {
  const across = Object.entries(UPS).filter(([, axis]) => Math.abs(dot(axis, up)) < 0.5);
  return across.reduce((best, each) => (dot(each[1], wanted) > dot(best[1], wanted) ? each : best))[0];
}

/**
 * Create the buttons.
 *
 * @param {import("./stage.js").Stage} stage
 * @param {(up: string, front: Vector) => void} choose receives the value of the option `up`, and the direction from
 *   which to look then
 */
export function uprightButtons(stage, choose) {
  const button = (/** @type {"turn" | "tip"} */ name, /** @type {(up: Vector, ahead: Vector) => [Vector, Vector]} */ turned) => h("button.tool", {
    type: "button", title: say[name], "aria-label": say[name], onclick: () => {
      if (!stage.viewer?.sides) return;
      const { up, axes: [, , forward] } = stage.viewer.camera, [wanted, front] = turned(up, UPS[turnedUp(up, forward)]);
      choose(turnedUp(up, wanted), front);
    },
  }, icon(name));
  return h("div.upright", button("turn", (up, ahead) => [cross(up, ahead), times(ahead, -1)]), button("tip", (up, ahead) => [ahead, up]));
}
