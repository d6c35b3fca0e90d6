// @ts-check
/** Transparent layer over the 3D view to paint on: strokes of a brush and images, which are undone one by one. */
import { h } from "./dom.js";

/** @typedef {{image?: ImageBitmap, color?: string, size?: number, points?: number[][]}} Mark image of the layer's size, or stroke, with its width and points in pixels of the layer */

export class PaintLayer {
  /** @type {Mark[]} */
  marks = [];
  /** Pointer that paints, and its stroke. @type {{id: number, points: number[][]} | null} */
  stroke = null;

  /**
   * @param {HTMLElement} frame element with the 3D view
   * @param {() => {color: string, size: number}} brush returns the color of the brush, and its diameter in CSS pixels
   * @param {() => void} changed called after each change of the marks
   */
  constructor(frame, brush, changed) {
    this.frame = frame;
    this.brush = brush;
    this.changed = changed;
    this.canvas = h("canvas.surface.paint", { "aria-hidden": "true" });
    this.tip = h("span.tip", { hidden: true });
    const listen = (/** @type {string} */ kind, /** @type {(event: PointerEvent) => void} */ act) => this.canvas.addEventListener(kind, act);
    listen("pointerdown", (event) => this.down(event));
    listen("pointermove", (event) => this.move(event));
    for (const kind of ["pointerup", "pointercancel"]) listen(kind, (event) => this.up(event));
    listen("pointerleave", () => (this.tip.hidden = true));
    listen("contextmenu", (event) => event.preventDefault());
  }

  /** Start with an empty layer. @param {number} width pixels @param {number} height */
  open(width, height) {
    [this.canvas.width, this.canvas.height] = [width, height];
    this.tip.hidden = true;
    this.frame.append(this.canvas, this.tip);
    this.marks = [];
    this.changed();
  }

  close() {
    this.canvas.remove();
    this.tip.remove();
    this.stroke = null;
  }

  /** Pixels of the layer per CSS pixel. The frame shows the whole layer, with its own aspect ratio. */
  get ratio() {
    const { width, height, clientWidth, clientHeight } = this.canvas;
    return Math.max(width / clientWidth, height / clientHeight);
  }

  /** @param {PointerEvent} event @returns {number[]} pixel of the layer */
  pixelOf(event) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect(), { ratio } = this;
    return [this.canvas.width / 2 + (event.clientX - left - width / 2) * ratio, this.canvas.height / 2 + (event.clientY - top - height / 2) * ratio];
  }

  /** @param {PointerEvent} event */
  down(event) {
    if (event.button !== 0 || this.stroke) return;
    event.preventDefault();
    this.canvas.setPointerCapture(event.pointerId);
    const { color, size } = this.brush(), [x, y] = this.pixelOf(event), points = [[x, y], [x + 0.01, y]]; // a line of no length would not be drawn
    this.stroke = { id: event.pointerId, points };
    this.add({ color, size: size * this.ratio, points });
  }

  /** @param {PointerEvent} event */
  move(event) {
    const box = this.canvas.getBoundingClientRect(), size = `${this.brush().size}px`;
    this.tip.hidden = event.pointerType === "touch";
    Object.assign(this.tip.style, { left: `${event.clientX - box.left}px`, top: `${event.clientY - box.top}px`, width: size, height: size });
    if (event.pointerId !== this.stroke?.id) return;
    const { points } = this.stroke, known = points.length, coalesced = event.getCoalescedEvents?.() ?? [];
    points.push(...(coalesced.length ? coalesced : [event]).map((each) => this.pixelOf(each)));
    this.draw(this.marks[this.marks.length - 1], known - 1);
  }

  /** @param {PointerEvent} event */
  up(event) {
    if (event.pointerId === this.stroke?.id) this.stroke = null;
  }

  /** @param {Mark} mark */
  add(mark) {
    this.marks.push(mark);
    this.draw(mark);
    this.changed();
  }

  undo() {
    if (this.stroke || !this.marks.pop()) return;
    this.context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    for (const mark of this.marks) this.draw(mark);
    this.changed();
  }

  get context() {
    return /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d"));
  }

  /** Draw an image, or a stroke from one of its points. @param {Mark} mark @param {number} [first] */
  draw({ image, color, size, points = [] }, first = 0) {
    const { context } = this;
    if (image) return context.drawImage(image, 0, 0);
    Object.assign(context, { strokeStyle: color, lineWidth: size, lineCap: "round", lineJoin: "round" });
    context.beginPath();
    for (const [x, y] of points.slice(first)) context.lineTo(x, y);
    context.stroke();
  }

  /** Return the layer as a PNG, transparent where nothing is painted. @returns {Promise<Blob>} */
  png() {
    return new Promise((done) => this.canvas.toBlob(done, "image/png"));
  }
}
