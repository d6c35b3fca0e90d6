// @ts-check
/** Boxes and spheres in the 3D view: their outlines, handles that move and resize them, and their numbers. */
import { h, put } from "./dom.js";
import { difference, dot, sum, times } from "./viewer/vectors.js";
import { words } from "./words.js";

/** @typedef {import("./viewer/viewer.js").Viewer} Viewer */
/** @typedef {import("./viewer/vectors.js").Vector} Vector */
/** @typedef {{kind: "box", center: Vector, sizes: Vector} | {kind: "sphere", center: Vector, sizes: Vector}} Shape `sizes`: half of the sides of a box, or the radius of a sphere three times */

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

export class ShapeHandles {
  /**
   * @param {Viewer} viewer
   * @param {HTMLElement} layer element that covers the canvas
   * @param {() => void} changed called after a handle has changed the shape
   */
  constructor(viewer, layer, changed) {
    this.viewer = viewer;
    this.layer = layer;
    this.changed = changed;
    /** @type {Shape | null} */
    this.shape = null;
    /** @type {{element: HTMLElement, place: () => Vector}[]} */
    this.handles = [];
  }

  /** @param {Shape | null} shape */
  show(shape) {
    if (shape?.kind !== this.shape?.kind) {
      this.handles.forEach(({ element }) => element.remove());
      this.handles = shape ? [this.moving(), ...(shape.kind === "box" ? AXES.flatMap((_, axis) => [this.sizing(axis, 1), this.sizing(axis, -1)]) : [this.sizing(0, 1)])] : [];
    }
    this.shape = shape;
    this.place();
  }

  /** Place the handles where the camera shows them. */
  place() {
    if (!this.shape) return;
    const { camera, canvas } = this.viewer, [fx, fy] = camera.pixels(canvas.clientWidth, canvas.clientHeight);
    for (const { element, place } of this.handles) {
      const [x, y, z] = camera.axes.map((axis) => dot(axis, difference(place(), camera.eye)));
      const left = canvas.clientWidth / 2 + (fx * x) / z, top = canvas.clientHeight / 2 + (fy * y) / z;
      element.hidden = !(z > camera.near);
      element.style.left = `${Math.max(0, Math.min(canvas.clientWidth, left))}px`;
      element.style.top = `${Math.max(0, Math.min(canvas.clientHeight, top))}px`;
    }
  }

  /** Return a handle that moves the shape across the view. */
  moving() {
    return this.handle(say.moveShape, () => this.at, (dx, dy, unit) => {
      const [right, down] = this.viewer.camera.axes;
      this.set({ center: sum(this.at, sum(times(right, dx * unit), times(down, dy * unit))) });
    });
  }

  /** Return a handle that moves one side of a box, or resizes a sphere. @param {number} axis @param {number} sign */
  sizing(axis, sign) {
    const direction = times(AXES[axis], sign);
    return this.handle(say.resize(["X", "Y", "Z"][axis], sign), () => sum(this.at, times(direction, this.sizes[axis])), (dx, dy, unit) => {
      const [right, down] = this.viewer.camera.axes, along = [dot(right, direction), dot(down, direction)], length = along[0] ** 2 + along[1] ** 2;
      const by = ((dx * along[0] + dy * along[1]) * unit) / Math.max(length, 0.05), sizes = [...this.sizes];
      if (this.shape?.kind === "sphere") return this.set({ sizes: sizes.map((size) => Math.max(1e-6, size + by)) });
      sizes[axis] = Math.max(1e-6, sizes[axis] + by / 2); // the opposite side stays
      this.set({ sizes, center: sum(this.at, times(direction, sizes[axis] - this.sizes[axis])) });
    });
  }

  get at() {
    return /** @type {Shape} */ (this.shape).center;
  }

  get sizes() {
    return /** @type {Shape} */ (this.shape).sizes;
  }

  /** @param {Partial<Shape>} values */
  set(values) {
    Object.assign(/** @type {Shape} */ (this.shape), values);
    this.place();
    this.changed();
  }

  /**
   * @param {string} name
   * @param {() => Vector} place
   * @param {(dx: number, dy: number, unit: number) => void} drag receives pixels, and the world units of a pixel there
   */
  handle(name, place, drag) {
    const element = h("button.handle", { type: "button", "aria-label": name, title: name });
    const { camera, canvas } = this.viewer;
    const by = (/** @type {number} */ dx, /** @type {number} */ dy) => {
      const depth = dot(camera.axes[2], difference(place(), camera.eye));
      drag(dx, dy, depth / camera.pixels(canvas.clientWidth, canvas.clientHeight)[0]);
    };
    element.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => element.setPointerCapture(event.pointerId));
    element.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => element.hasPointerCapture(event.pointerId) && by(event.movementX, event.movementY));
    element.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      if (!KEYS[event.key]) return;
      event.preventDefault();
      event.stopPropagation();
      by(...KEYS[event.key]);
    });
    this.layer.append(element);
    return { element, place };
  }
}

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
