// @ts-check
/** Box or sphere in the 3D view that is changed by its handles or by numbers. */
import { h, put } from "./dom.js";
import { outline, ShapeHandles } from "./shapes.js";
import { words } from "./words.js";

/** @typedef {import("./shapes.js").Shape} Shape */

const say = words.select;

export class ShapeTool {
  /**
   * @param {import("./stage.js").Stage} stage
   * @param {(lines: Float32Array<ArrayBuffer>) => void} draw receives the outline, as pairs of points; empty for none
   */
  constructor(stage, draw) {
    this.stage = stage;
    this.draw = draw;
    /** @type {Shape | null} */
    this.shape = null;
    /** @type {HTMLInputElement[]} */
    this.inputs = [];
    this.numbers = h("div.numbers");
    const layer = h("div.handles");
    if (stage.viewer) this.handles = new ShapeHandles(stage.viewer, layer, () => this.changed());
    stage.frame.append(layer);
  }

  /** @param {Shape | null} shape */
  show(shape) {
    this.shape = shape;
    this.handles?.show(shape);
    const names = shape ? [...say.center, ...(shape.kind === "box" ? say.sizes : [say.sphereRadius])] : [];
    this.inputs = names.map((name) => h("input", { type: "number", step: "any", "aria-label": name, title: name, oninput: () => this.numbersChanged() }));
    put(this.numbers, this.inputs.map((input, i) => h("label", h("span", names[i]), input)));
    this.changed();
    this.follow();
  }

  changed() {
    const { shape } = this;
    if (shape) [...shape.center, ...shape.sizes].slice(0, this.inputs.length).forEach((value, i) => (this.inputs[i].value = String(Number(value.toPrecision(5)))));
    this.draw(shape ? outline(shape) : new Float32Array(0));
  }

  numbersChanged() {
    const values = this.inputs.map((input) => Number(input.value)), { shape } = this;
    if (!shape || values.some((value) => !Number.isFinite(value)) || values.slice(3).some((value) => value <= 0)) return;
    Object.assign(shape, { center: values.slice(0, 3), sizes: shape.kind === "box" ? values.slice(3) : Array(3).fill(values[3]) });
    this.draw(outline(shape));
  }

  /**
   * Return the change of a selection by what is inside the shape, for `Selection.ask`.
   *
   * @param {import("./viewer/selector.js").Mode} mode
   * @returns {[string, Record<string, any>]}
   */
  request(mode) {
    const { kind, center, sizes } = /** @type {Shape} */ (this.shape);
    if (kind === "sphere") return [kind, { center, radius: sizes[0], mode }];
    return [kind, { low: center.map((value, axis) => value - sizes[axis]), high: center.map((value, axis) => value + sizes[axis]), mode }];
  }

  /** Keep the handles where the camera shows the shape. */
  follow() {
    cancelAnimationFrame(this.requested ?? 0);
    if (!this.shape || this.stage.viewer?.ended !== false) return;
    this.handles?.place();
    this.requested = requestAnimationFrame(() => this.follow());
  }
}

/**
 * Return a shape around the middle of a scene, or the box around its bulk.
 *
 * @param {"box" | "sphere"} kind
 * @param {import("./viewer/splat_scene.js").Middle} middle
 * @param {number} [share] fraction of the bulk's size
 * @returns {Shape}
 */
export function shapeAround(kind, { center, radius, low, high }, share = 0.5) {
  if (kind === "sphere") return { kind, center: [...center], sizes: Array(3).fill(radius * share) };
  const sizes = high.map((value, axis) => Math.max((share * (value - low[axis])) / 2, 1e-6));
  return { kind, center: share < 1 ? [...center] : high.map((value, axis) => (value + low[axis]) / 2), sizes };
}
