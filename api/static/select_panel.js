// @ts-check
/** Tools to select Gaussians in the 3D view: brush, lasso, box, sphere and similar colors. */
import { h, put } from "./dom.js";
import { button, check, radios, range } from "./fields.js";
import { shapeAround, ShapeTool } from "./shapes.js";
import { Selection } from "./viewer/selection.js";
import { words } from "./words.js";

/** @typedef {{bits: Uint8Array, total: number}} Mask `bits`: one for each Gaussian, the lowest bit first; `total`: number of selected ones */
/** @typedef {"move" | "brush" | "lasso" | "box" | "sphere" | "similar"} Tool */

const say = words.select;

export class SelectPanel {
  /** @param {import("./stage.js").Stage} stage */
  constructor(stage) {
    this.stage = stage;
    this.leaving = new AbortController();
    /** @type {Tool} */
    this.tool = "move";
    /** @type {import("./viewer/selector.js").Mode} */
    this.mode = "add";
    /** @type {Selection | null} */
    this.selection = null;
    /** Points of the current stroke or lasso, in CSS pixels of the canvas. @type {number[]} */
    this.drawn = [];
    this.change = 0;
    this.total = 0;
    this.erasing = false;
    /** Points of a stroke to send at the next frame, and its request. @type {number[]} */
    this.waiting = [];
    this.requested = 0;
    /** Pixel of the color that was picked, until something else changes the selection. @type {number[] | undefined} */
    this.seed = undefined;
    /** Whether a request for similar colors is running, whether another one follows, and whether the last one changed something. */
    this.asking = this.again = this.changes = false;
    /** @type {((mask: Mask | null) => void) | null} */
    this.finish = null;
    /** Controls of the panel. @type {any} */
    this.parts = {};
    this.surface = h("canvas.surface", {
      hidden: true, "aria-hidden": "true", onpointerup: () => this.up(), onpointercancel: () => this.up(),
      onpointerleave: () => !this.drawn.length && this.paint(),
      onpointerdown: (/** @type {PointerEvent} */ event) => this.down(event),
      onpointermove: (/** @type {PointerEvent} */ event) => this.move(event),
      oncontextmenu: (/** @type {Event} */ event) => event.preventDefault(),
      onwheel: (/** @type {WheelEvent} */ event) => stage.controls?.wheel(event),
    });
    this.counted = h("output");
    stage.frame.append(this.surface);
    this.shapes = new ShapeTool(stage, (lines) => {
      stage.outline = lines;
      stage.drawFrames();
    });
    this.build();
    stage.element.append(this.element);
    document.addEventListener("keydown", (event) => this.key(event), { signal: this.leaving.signal });
  }

  build() {
    this.parts.title = h("h2");
    this.parts.radius = range(say.radius, { min: 2, max: 150, value: 24 });
    this.parts.tolerance = range(say.tolerance, { min: 0, max: 100, value: 12, oninput: () => this.similarAgain() });
    this.parts.through = check(say.through);
    this.parts.connected = check(say.connected, true);
    this.parts.connected.input.addEventListener("change", () => this.similarAgain());
    this.parts.toolHelp = h("p.help");
    this.parts.middle = button(say.atMiddle, () => this.similarAtMiddle());
    this.parts.apply = button(say.apply, () => this.shapes.shape && this.ask(...this.shapes.request(this.mode)));
    this.parts.undo = button(say.undo, () => this.ask("undo"));
    this.parts.redo = button(say.redo, () => this.ask("redo"));
    this.parts.modeRadios = radios(say.mode, say.modes, (mode) => (this.mode = mode));
    this.parts.toolRadios = radios(say.tool, say.tools, (tool) => this.choose(tool));
    this.element = h("section.selecting", { hidden: true, "aria-label": say.name }, h("div.row", this.parts.title, this.counted),
      h("div.row", this.parts.toolRadios, this.parts.modeRadios), this.parts.toolHelp,
      h("div.row", this.parts.radius.element, this.parts.through.element, this.parts.tolerance.element, this.parts.connected.element, this.parts.middle, this.shapes.numbers, this.parts.apply),
      h("div.row", this.parts.undo, this.parts.redo, button(say.invert, () => this.ask("invert")), button(say.clear, () => this.ask("clear")),
        h("span.grow"), button(say.cancel, () => this.close(null)), button(say.done, () => this.done(), "primary")));
    this.choose("move");
  }

  /**
   * Let the user change a selection.
   *
   * @param {string} name name of the region
   * @param {Mask | null} mask selection to start from
   * @param {(mask: Mask | null) => void} finish receives the selection, or null if it was canceled
   */
  open(name, mask, finish) {
    const { viewer } = this.stage, scene = viewer?.sides?.left.scene;
    if (!viewer || !scene?.whole) return false;
    this.close(null);
    this.finish = finish;
    this.scene = scene;
    this.selection = new Selection(viewer, scene, (changed) => this.changed(changed));
    this.selection.ask("load", { bits: mask?.bits ?? new Uint8Array(Math.ceil((scene.header?.count ?? 0) / 8)) });
    put(this.parts.title, say.of(name));
    this.element.hidden = false;
    this.stage.setHelp(say.help);
    this.choose("brush");
    this.stage.element.scrollIntoView({ block: matchMedia("(max-width: 1000px)").matches ? "start" : "nearest" });
    /** @type {HTMLInputElement} */ (this.parts.toolRadios.querySelector("input:checked")).focus({ preventScroll: true });
    return true;
  }

  /** Use the selection if it has Gaussians, else leave it. */
  async settle() {
    if (this.total) await this.done();
    else this.close(null);
  }

  async done() {
    const { selection } = this;
    if (!selection) return;
    const { bits, total } = await selection.ask("bits");
    if (selection === this.selection && bits) this.close({ bits, total });
  }

  /** @param {Mask | null} mask */
  close(mask) {
    if (!this.selection) return;
    const { finish } = this;
    this.total = 0;
    this.choose("move");
    this.selection.end();
    this.selection = null;
    this.finish = null;
    this.element.hidden = true;
    this.stage.setHelp();
    finish?.(mask);
  }

  /** @param {Tool} tool */
  choose(tool) {
    this.tool = tool;
    const input = this.parts.toolRadios.querySelector(`[value=${tool}]`);
    if (input) input.checked = true;
    const shaped = tool === "box" || tool === "sphere", drawing = tool === "brush" || tool === "lasso";
    this.parts.toolHelp.textContent = tool === "brush" && matchMedia("(pointer: coarse)").matches ? say.brushTouch : say.toolHelp[tool];
    this.surface.hidden = !(drawing || tool === "similar");
    this.parts.radius.element.hidden = tool !== "brush";
    this.parts.through.element.hidden = !drawing;
    for (const part of [this.parts.tolerance.element, this.parts.connected.element, this.parts.middle]) part.hidden = tool !== "similar";
    for (const part of [this.shapes.numbers, this.parts.apply]) part.hidden = !shaped;
    this.seed = undefined;
    this.shapes.show((tool === "box" || tool === "sphere") && this.scene?.middle ? shapeAround(tool, this.scene.middle) : null);
    this.paint();
  }

  /** @param {import("./viewer/selection.js").Changed} changed */
  changed({ total, past, future }) {
    if (!this.selection) return;
    this.total = total;
    this.counted.textContent = say.selected(total, this.selection.count);
    this.parts.undo.disabled = !past;
    this.parts.redo.disabled = !future;
    this.stage.viewer?.draw();
  }

  /** @param {string} op @param {Record<string, any>} [values] */
  ask(op, values) {
    this.seed = op === "similar" ? this.seed : undefined;
    return this.selection?.ask(op, values);
  }

  /** @param {PointerEvent} event */
  down(event) {
    const { stage, surface } = this;
    if (!this.selection) return;
    if (event.button !== 0 || !event.isPrimary) return void stage.controls?.down(event);
    surface.setPointerCapture(event.pointerId);
    this.selection.look();
    this.change++;
    this.erasing = event.altKey;
    this.drawn = this.pointOf(event);
    if (this.tool === "similar") this.pick(this.drawn);
    else this.draw(this.drawn);
  }

  /** @param {PointerEvent} event */
  move(event) {
    const point = this.pointOf(event);
    if (this.drawn.length && this.tool !== "similar") {
      const last = this.drawn.slice(-2);
      this.drawn.push(...point);
      this.draw([...last, ...point]);
    }
    this.paint(point);
  }

  up() {
    if (this.tool === "lasso" && this.drawn.length >= 6) this.ask("lasso", { points: this.inView(this.drawn), ...this.how });
    if (this.tool === "brush" && this.how.mode === "intersect" && this.drawn.length) this.stroke(this.drawn);
    this.drawn = [];
    this.paint();
  }

  /** Apply the brush to a part of a stroke; parts that arrive before the next frame are sent together. @param {number[]} points */
  draw(points) {
    if (this.tool !== "brush" || this.how.mode === "intersect") return; // intersects with the whole stroke at its end
    this.waiting.push(...points);
    this.requested ||= requestAnimationFrame(() => {
      this.stroke(this.waiting);
      [this.waiting, this.requested] = [[], 0];
    });
  }

  /** @param {number[]} points */
  stroke(points) {
    if (!this.selection) return;
    const radius = (Number(this.parts.radius.input.value) * this.selection.size[0]) / this.stage.canvas.clientWidth;
    this.ask("stroke", { points: this.inView(points), radius, change: this.change, ...this.how });
  }

  /** @param {PointerEvent} event */
  pointOf(event) {
    const { left, top } = this.surface.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  }

  /** @param {number[]} points */
  inView(points) {
    const found = [];
    for (let k = 0; k < points.length; k += 2) found.push(.../** @type {Selection} */ (this.selection).point(points[k], points[k + 1]));
    return found;
  }

  get how() {
    const opposite = this.mode === "subtract" ? "add" : "subtract";
    return { mode: this.erasing ? opposite : this.mode, through: this.parts.through.input.checked };
  }

  /** @param {number[]} at */
  pick(at) {
    this.seed = this.inView(at);
    this.similar(false);
  }

  similarAtMiddle() {
    const { clientWidth, clientHeight } = this.stage.canvas;
    this.selection?.look();
    this.erasing = false;
    this.pick([clientWidth / 2, clientHeight / 2]);
  }

  similarAgain() {
    if (this.seed) this.similar(true);
  }

  /** @param {boolean} replaces whether to replace the last change, which had another tolerance */
  async similar(replaces) {
    if (this.asking) return void (this.again = replaces);
    this.asking = true;
    const changed = await this.ask("similar", { point: this.seed, tolerance: Number(this.parts.tolerance.input.value) / 100, connected: this.parts.connected.input.checked, replaces: replaces && this.changes, ...this.how });
    this.asking = false;
    this.changes = !!changed?.flags.length || (replaces && this.changes);
    if (this.again && this.seed) {
      this.again = false;
      this.similar(true);
    }
  }

  /** Draw the brush at a point, or the lasso. @param {number[]} [point] */
  paint(point) {
    const { surface, drawn } = this, ratio = window.devicePixelRatio || 1, context = surface.getContext("2d");
    [surface.width, surface.height] = [surface.clientWidth * ratio, surface.clientHeight * ratio];
    if (!context) return;
    context.scale(ratio, ratio);
    context.lineWidth = 1.5;
    for (const [style, wide] of [["rgb(0 0 0 / 60%)", 3.5], ["#fff", 1.5]]) {
      [context.strokeStyle, context.lineWidth] = [style, Number(wide)];
      context.beginPath();
      if (this.tool === "brush" && point) context.arc(point[0], point[1], Number(this.parts.radius.input.value), 0, 2 * Math.PI);
      if (this.tool === "lasso") for (let k = 0; k < drawn.length; k += 2) context.lineTo(drawn[k], drawn[k + 1]);
      if (this.tool === "lasso") context.closePath();
      context.stroke();
    }
  }

  /** Handle the shortcuts of the panel, except while a text is edited. @param {KeyboardEvent} event */
  key(event) {
    const { target } = event, text = target instanceof HTMLInputElement && !["radio", "checkbox", "range"].includes(target.type);
    const key = event.key.toLowerCase(), controlled = event.ctrlKey || event.metaKey;
    if (this.selection && key === "escape" && (target === document.body || this.stage.element.contains(/** @type {Node} */ (target)))) return this.close(null);
    if (!this.selection || event.altKey || (text && !(controlled && this.element.contains(target)))) return;
    const { input } = this.parts.radius;
    /** @type {Record<string, () => void>} */
    const actions = controlled
      ? { y: () => this.ask("redo"), z: () => this.ask(event.shiftKey ? "redo" : "undo"), i: () => this.ask("invert") }
      : { v: () => this.choose("move"), b: () => this.choose("brush"), l: () => this.choose("lasso"), r: () => this.choose("box"), "[": () => (input.value -= 4), "]": () => (input.value = Number(input.value) + 4) };
    if (!actions[key]) return;
    event.preventDefault();
    actions[key]();
  }

  end() {
    this.leaving.abort();
    this.selection = null;
  }
}
