// @ts-check
/** Controls of the viewer: mouse, touch, pen, wheel and keys. */

/** @typedef {import("./viewer.js").Viewer} Viewer */

/** @type {Record<string, [number, number]>} */
const TURNS = { ArrowLeft: [-0.08, 0], ArrowRight: [0.08, 0], ArrowUp: [0, -0.08], ArrowDown: [0, 0.08] };
/** Steps along right, down and forward. @type {Record<string, number[]>} */
const STEPS = { a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0], w: [0, 0, 1], s: [0, 0, -1] };

export class Controls {
  /**
   * @param {Viewer} viewer
   * @param {{moved?: () => void, toggle?: () => void, camera?: (by: number) => void, home?: () => void, hold?: (held: boolean) => void}} keys actions of other keys; `moved` is called when keys or the wheel move the camera, `hold` is called when O is pressed and released
   */
  constructor(viewer, keys = {}) {
    this.viewer = viewer;
    this.keys = keys;
    /** Whether to rotate about the scene; otherwise about the eye. */
    this.orbit = true;
    /** @type {Map<number, {x: number, y: number}>} */
    this.hands = new Map();
    const { canvas } = viewer;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => this.hands.delete(/** @type {PointerEvent} */ (event).pointerId));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("keyup", (event) => event.key.toLowerCase() === "o" && this.keys.hold?.(false));
    canvas.addEventListener("blur", () => this.keys.hold?.(false));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  /** @param {PointerEvent} event */
  down(event) {
    this.viewer.canvas.setPointerCapture(event.pointerId);
    this.hands.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  /** @param {PointerEvent} event */
  move(event) {
    const before = this.hands.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    const others = [...this.hands].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.hands.set(event.pointerId, now);
    const dx = now.x - before.x, dy = now.y - before.y;
    if (others.length) this.pinch(before, now, others[0], dx, dy);
    else if (event.buttons & 2 || event.shiftKey) this.shift(dx, dy);
    else this.viewer.camera.turn(dx / 180, dy / 180, this.orbit);
    this.viewer.moved();
  }

  /**
   * Handle two fingers: their distance zooms, their midpoint pans.
   *
   * @param {{x: number, y: number}} before
   * @param {{x: number, y: number}} now
   * @param {{x: number, y: number}} other
   * @param {number} dx
   * @param {number} dy
   */
  pinch(before, now, other, dx, dy) {
    const was = Math.hypot(before.x - other.x, before.y - other.y), is = Math.hypot(now.x - other.x, now.y - other.y);
    if (was > 1 && is > 1) this.approach(was / is);
    this.shift(dx / 2, dy / 2);
  }

  /**
   * @param {number} dx pixels
   * @param {number} dy
   */
  shift(dx, dy) {
    const { camera, canvas } = this.viewer;
    const unit = camera.distance / camera.pixels(canvas.clientWidth, canvas.clientHeight)[1];
    camera.move([-dx * unit, -dy * unit, 0]);
  }

  /** @param {number} factor */
  approach(factor) {
    const { camera } = this.viewer;
    if (this.orbit) camera.approach(factor);
    else camera.move([0, 0, (1 - factor) * camera.size]);
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
    this.approach(Math.exp(Math.max(-400, Math.min(400, pixels)) / 900));
    this.keys.moved?.();
    this.viewer.moved();
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { viewer } = this, { camera } = viewer, key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (TURNS[key]) camera.turn(...TURNS[key], this.orbit);
    else if (STEPS[key]) camera.move(STEPS[key].map((part) => part * 0.06 * camera.size));
    else if (key === "+" || key === "=") this.approach(0.9);
    else if (key === "-") this.approach(1 / 0.9);
    else if (key === " ") return this.other(event, this.keys.toggle);
    else if (key === "o") return this.other(event, () => event.repeat || this.keys.hold?.(true));
    else if (key === "Home") return this.other(event, this.keys.home);
    else if (key === "," || key === ".") return this.other(event, () => this.keys.camera?.(key === "," ? -1 : 1));
    else return;
    event.preventDefault();
    this.keys.moved?.();
    viewer.moved();
  }

  /**
   * @param {Event} event
   * @param {(() => void) | undefined} act
   */
  other(event, act) {
    event.preventDefault();
    act?.();
  }
}
