// @ts-check
/** Dialog to rotate and crop a painting in the browser; what is uploaded is the result, in sRGB. */
import { h, put } from "./dom.js";
import { words } from "./words.js";

const say = words.painting;
/** Largest side of the image in the dialog, in pixels. */
const SHOWN = 640;
/** Quality of a JPEG that is made. */
const QUALITY = 0.95;

/** @typedef {[number, number, number, number]} Frame left, top, right and bottom edge, as fractions of the image */

/**
 * Return an image after quarter turns, in sRGB.
 *
 * @param {ImageBitmap} image
 * @param {number} turns clockwise
 * @param {Frame} frame part of the turned image
 * @param {number} [scale]
 */
function turnedAndCropped(image, turns, [left, top, right, bottom], scale = 1) {
  const [width, height] = turns % 2 ? [image.height, image.width] : [image.width, image.height];
  const canvas = h("canvas", { width: Math.max(1, Math.round((right - left) * width * scale)), height: Math.max(1, Math.round((bottom - top) * height * scale)) });
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { colorSpace: "srgb" }));
  context.scale(scale, scale);
  context.translate(width / 2 - Math.round(left * width), height / 2 - Math.round(top * height));
  context.rotate((turns * Math.PI) / 2);
  context.drawImage(image, -image.width / 2, -image.height / 2);
  return canvas;
}

/** Return a canvas as a file: a JPEG if the original is one, else a lossless PNG. @param {HTMLCanvasElement} canvas @param {string} name @returns {Promise<File>} */
async function fileOf(canvas, name) {
  const isJpeg = /\.jpe?g$/i.test(name), type = isJpeg ? "image/jpeg" : "image/png";
  const blob = await new Promise((done) => canvas.toBlob(done, type, QUALITY));
  if (!blob) throw new Error(say.tooLarge);
  return new File([blob], isJpeg || /\.png$/i.test(name) ? name : `${name.replace(/\.[^.]*$/, "")}.png`, { type });
}

/** Let the user rotate and crop a painting; null if it stays as it is. @param {Blob} blob @param {string} name */
export async function editPainting(blob, name) {
  const image = await createImageBitmap(blob).catch(() => {
    throw new Error(say.unreadable(name));
  });
  let turns = 0, frame = /** @type {Frame} */ ([0, 0, 1, 1]);
  const picture = h("div.picture"), edge = h("div.edge"), area = h("div.area", picture, edge);
  const inputs = say.edges.map((title, i) => h("input", { type: "number", min: 0, max: 100, step: "any", "aria-label": title, oninput: () => set(frame.map((value, k) => (k === i ? Number(inputs[i].value) / 100 : value))) }));
  const show = (typed = false) => {
    frame.forEach((value, i) => (edge.style[/** @type {any} */ (["left", "top", "right", "bottom"][i])] = `${100 * (i < 2 ? value : 1 - value)}%`));
    if (!typed) inputs.forEach((/** @type {HTMLInputElement} */ input, /** @type {number} */ i) => (input.value = String(Math.round(1000 * frame[i]) / 10)));
  };
  const set = (/** @type {number[]} */ [left, top, right, bottom], typed = true) => {
    const inside = (/** @type {number} */ value) => Math.max(0, Math.min(1, value || 0));
    const next = /** @type {Frame} */ ([left, top, right, bottom].map(inside));
    if (next[2] - next[0] < 0.01 || next[3] - next[1] < 0.01) return;
    frame = next;
    show(typed);
  };
  const turn = (/** @type {number} */ by) => {
    const [left, top, right, bottom] = frame;
    turns = (turns + by + 4) % 4;
    if (by) frame = by > 0 ? [1 - bottom, left, 1 - top, right] : [top, 1 - right, bottom, 1 - left];
    put(picture, turnedAndCropped(image, turns, [0, 0, 1, 1], Math.min(1, SHOWN / Math.max(image.width, image.height))));
    show();
  };
  const at = (/** @type {PointerEvent} */ event) => {
    const { left, top, width, height } = area.getBoundingClientRect();
    return [(event.clientX - left) / width, (event.clientY - top) / height];
  };
  let from = [0, 0];
  area.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => (area.setPointerCapture(event.pointerId), (from = at(event))));
  area.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => {
    if (!area.hasPointerCapture(event.pointerId)) return;
    const [x, y] = at(event);
    set([Math.min(x, from[0]), Math.min(y, from[1]), Math.max(x, from[0]), Math.max(y, from[1])], false);
  });
  const button = (/** @type {string} */ title, /** @type {() => void} */ onclick, kind = "quiet") => h(`button.${kind}`, { type: "button", onclick }, title);
  const dialog = h("dialog.editor", { "aria-label": say.edit(name) }, h("p.help", say.help), area,
    h("div.row", button(say.left, () => turn(-1)), button(say.right, () => turn(1)), h("span.grow"), say.edges.map((title, i) => h("label", h("span", title), inputs[i]))),
    h("div.row", button(say.whole, () => set([0, 0, 1, 1], false)), h("span.grow"), button(words.select.cancel, () => dialog.close()), button(say.use, () => dialog.close("use"), "primary")));
  turn(0);
  document.body.append(dialog);
  dialog.showModal();
  await new Promise((done) => dialog.addEventListener("close", done));
  dialog.remove();
  const changed = dialog.returnValue === "use" && (turns > 0 || String(frame) !== "0,0,1,1");
  return changed ? fileOf(turnedAndCropped(image, turns, frame), name) : null;
}
