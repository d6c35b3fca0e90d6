// @ts-check
/** Panel to crop a scene to a box in the 3D view: what lies outside keeps its colors. */
import { announce, h } from "./dom.js";
import { button, tool } from "./fields.js";
import { outline, shapeAround, ShapeTool } from "./shapes.js";
import { words } from "./words.js";

/** @typedef {import("./shapes.js").Shape} Shape */

const say = words.crop;

/** Return the box of numbers "X0,Y0,Z0,X1,Y1,Z1". @param {string} text @returns {Shape} */
function boxOf(text) {
  const numbers = text.split(",").map(Number), far = numbers.slice(3);
  return { kind: "box", center: far.map((value, axis) => (value + numbers[axis]) / 2), sizes: far.map((value, axis) => Math.abs(value - numbers[axis]) / 2) };
}

/** Return the text of a box. @param {Shape} shape */
const boxText = ({ center, sizes }) => [-1, 1].flatMap((sign) => center.map((value, axis) => Number((value + sign * sizes[axis]).toPrecision(5)))).join(",");

export class CropPanel {
  /**
   * @param {import("./stage.js").Stage} stage
   * @param {(box: string) => void} apply receives the text of the box; "" for none
   * @param {() => void} changed called after another box is in use
   */
  constructor(stage, apply, changed) {
    this.stage = stage;
    this.apply = apply;
    this.changed = changed;
    /** Text of the box in use; "" for none. */
    this.box = "";
    this.button = tool("crop", say.crop, () => (this.element.hidden ? this.open() : this.close()), { hidden: true, "aria-pressed": "false" });
    this.remove = button(say.remove, () => this.use(""));
    this.first = button(say.use, () => this.use(this.tool.shape ? boxText(this.tool.shape) : ""), "primary");
    this.tool = new ShapeTool(stage, (lines) => this.draw(lines));
    this.element = h("section.selecting", { hidden: true, "aria-label": say.crop }, h("p.help", say.help), h("div.row", this.tool.numbers), h("div.row", this.remove, h("span.grow"), button(words.select.cancel, () => this.close()), this.first));
    this.element.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => event.key === "Escape" && (this.close(), this.button.focus()));
    stage.tools.prepend(this.button);
    stage.element.append(this.element);
  }

  open() {
    const middle = this.stage.viewer?.sides?.left.scene.middle;
    if (!middle) return announce(words.select.notLoaded);
    this.remove.hidden = !this.box;
    this.element.hidden = false;
    this.tool.show(this.box ? boxOf(this.box) : shapeAround("box", middle, 1.3));
    this.first.focus({ preventScroll: true });
    this.element.scrollIntoView({ block: "nearest" });
  }

  close() {
    this.element.hidden = true;
    this.tool.show(null);
  }

  /** @param {string} box */
  use(box) {
    this.close();
    this.apply(box);
  }

  /** Show a box as the one in use. @param {string} box */
  show(box) {
    if (box === this.box) return;
    this.box = box;
    this.button.setAttribute("aria-pressed", String(!!box));
    if (this.element.hidden) this.draw(new Float32Array(0));
    this.changed();
  }

  /** Return the bounds of what remains of the scene, which an orbit surrounds; undefined until it is loaded. */
  remaining() {
    const middle = this.stage.viewer?.sides?.left.scene.middle;
    if (!middle || !this.box) return middle;
    const { center, sizes } = boxOf(this.box);
    return { ...middle, low: middle.low.map((low, i) => Math.max(low, center[i] - sizes[i])), high: middle.high.map((high, i) => Math.min(high, center[i] + sizes[i])) };
  }

  /** Draw the outline of the box that is being changed, or of the one in use. @param {Float32Array<ArrayBuffer>} lines */
  draw(lines) {
    this.stage.cropped = lines.length || !this.box ? lines : outline(boxOf(this.box));
    this.stage.drawFrames();
  }
}
