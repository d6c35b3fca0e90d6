// @ts-check
/** Boxes and spheres in the 3D view: their outlines, handles that move and resize them, and their numbers. */
import { h, put } from "./dom.js";
import { difference, dot, sum, times } from "./viewer/vectors.js";
import { words } from "./words.js";

/** @typedef {import("./stage.js").Stage} Stage */
/** @typedef {import("./viewer/viewer.js").Viewer} Viewer */
/** @typedef {import("./viewer/vectors.js").Vector} Vector */
/** @typedef {{kind: "box" | "sphere", center: Vector, sizes: Vector}} Shape `sizes`: half of the sides of a box, or the radius of a sphere three times */

const say = words.select;
const AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
/** Steps of a circle. */
const STEPS = 48;
/** @type {Record<string, [number, number]>} */
const KEYS = { ArrowLeft: [-8, 0], ArrowRight: [8, 0], ArrowUp: [0, -8], ArrowDown: [0, 8] };

/** Return the outline of a shape as pairs of points [n * 2 * 3]. @param {Shape} shape */
export function outline({ kind, center, sizes }) {
  /** @type {number[]} */
  const points = [];
  if (kind === "sphere") {
    for (const axis of [0, 1, 2]) {
      const at = (/** @type {number} */ k) => {
        const angle = (2 * Math.PI * k) / STEPS, point = [...center];
        point[(axis + 1) % 3] += sizes[0] * Math.cos(angle);
        point[(axis + 2) % 3] += sizes[0] * Math.sin(angle);
        return point;
      };
      for (let k = 0; k < STEPS; k++) points.push(...at(k), ...at(k + 1));
    }
    return new Float32Array(points);
  }
  const corner = (/** @type {number} */ bits) => center.map((value, axis) => value + (bits & (1 << axis) ? 1 : -1) * sizes[axis]);
  for (let bits = 0; bits < 8; bits++) for (const axis of [0, 1, 2]) if (!(bits & (1 << axis))) points.push(...corner(bits), ...corner(bits | (1 << axis)));
  return new Float32Array(points);
}

export class ShapeTool {
  /** @param {Stage} stage @param {(lines: Float32Array<ArrayBuffer>) => void} draw receives pairs of points */
  constructor(stage, draw) {
    this.stage = stage;
    this.draw = draw;
    /** @type {Shape | null} */
    this.shape = null;
    /** @type {HTMLInputElement[]} */
    this.inputs = [];
    /** @type {{element: HTMLElement, place: () => Vector}[]} */
    this.handles = [];
    this.numbers = h("div.numbers");
    this.layer = h("div.handles");
    stage.frame.append(this.layer);
  }

  /** @param {Shape | null} shape */
  show(shape) {
    const { viewer } = this.stage, box = shape?.kind === "box";
    this.shape = shape;
    this.handles = !shape || !viewer ? [] : [this.moving(shape, viewer), ...(box ? AXES.flatMap((_, axis) => [1, -1].map((sign) => this.sizing(shape, viewer, axis, sign))) : [this.sizing(shape, viewer, 0, 1)])];
    put(this.layer, this.handles.map(({ element }) => element));
    const names = shape ? [...say.center, ...(box ? say.sizes : [say.sphereRadius])] : [];
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

  /** Return a handle that moves the shape across the view. @param {Shape} shape @param {Viewer} viewer */
  moving(shape, viewer) {
    return this.handle(say.moveShape, viewer, () => shape.center, (dx, dy, unit) => {
      const [right, down] = viewer.camera.axes;
      shape.center = sum(shape.center, sum(times(right, dx * unit), times(down, dy * unit)));
    });
  }

  /** Return a resizing handle. @param {Shape} shape @param {Viewer} viewer @param {number} axis @param {number} sign */
  sizing(shape, viewer, axis, sign) {
    const direction = times(AXES[axis], sign), place = () => sum(shape.center, times(direction, shape.sizes[axis]));
    return this.handle(say.resize(["X", "Y", "Z"][axis], sign), viewer, place, (dx, dy, unit) => {
      const [right, down] = viewer.camera.axes, along = [dot(right, direction), dot(down, direction)], length = along[0] ** 2 + along[1] ** 2;
      const by = ((dx * along[0] + dy * along[1]) * unit) / Math.max(length, 0.05), before = shape.sizes[axis];
      if (shape.kind === "sphere") return void (shape.sizes = Array(3).fill(Math.max(1e-6, before + by)));
      shape.sizes[axis] = Math.max(1e-6, before + by / 2);
      shape.center = sum(shape.center, times(direction, shape.sizes[axis] - before)); // the opposite side stays
    });
  }

  /**
   * @param {string} name
   * @param {Viewer} viewer
   * @param {() => Vector} place
   * @param {(dx: number, dy: number, unit: number) => void} drag receives pixels, and the world units of a pixel there
   */
  handle(name, { camera, canvas }, place, drag) {
    const element = h("button.handle", { type: "button", "aria-label": name, title: name });
    const by = (/** @type {number} */ dx, /** @type {number} */ dy) => {
      const depth = dot(camera.axes[2], difference(place(), camera.eye));
      drag(dx, dy, depth / camera.pixels(canvas.clientWidth, canvas.clientHeight)[0]);
      this.changed();
    };
    element.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => element.setPointerCapture(event.pointerId));
    element.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => element.hasPointerCapture(event.pointerId) && by(event.movementX, event.movementY));
    element.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      if (!KEYS[event.key]) return;
      event.preventDefault();
      event.stopPropagation();
      by(...KEYS[event.key]);
    });
    return { element, place };
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
    const { viewer } = this.stage;
    cancelAnimationFrame(this.requested ?? 0);
    if (!this.shape || !viewer || viewer.ended) return;
    const { camera, canvas } = viewer, [fx, fy] = camera.pixels(canvas.clientWidth, canvas.clientHeight);
    for (const { element, place } of this.handles) {
      const [x, y, z] = camera.axes.map((axis) => dot(axis, difference(place(), camera.eye)));
      const left = canvas.clientWidth / 2 + (fx * x) / z, top = canvas.clientHeight / 2 + (fy * y) / z;
      element.hidden = !(z > camera.near);
      element.style.left = `${Math.max(0, Math.min(canvas.clientWidth, left))}px`;
      element.style.top = `${Math.max(0, Math.min(canvas.clientHeight, top))}px`;
    }
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
