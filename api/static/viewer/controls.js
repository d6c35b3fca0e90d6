// @ts-check
/** Controls of the viewer: mouse, touch, pen, wheel and keys, and movements over time. */
import { difference, sum, times } from "./vectors.js";

/** @typedef {import("./viewer.js").Viewer} Viewer */
/** @typedef {import("../cameras.js").JobCamera} JobCamera */
/** @typedef {{moved?: () => void, toggle?: () => void, camera?: (by: number) => void, viewpoint?: (index: number) => void, home?: () => void, hold?: (held: boolean) => void}} Actions `moved` is called when the camera leaves its place, `hold` when O is pressed and released */

export class Controls {
  /** Actions of other keys. @type {Actions} */
  keys = {};

  /** @param {Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
    this.motion = new Motion(viewer);
    /** @type {Map<number, {x: number, y: number}>} */
    this.hands = new Map();
    /** Last position of the pointer, in the window. @type {{x: number, y: number} | null} */
    this.pointer = null;
    const { canvas } = viewer;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => this.hands.delete(/** @type {PointerEvent} */ (event).pointerId));
    canvas.addEventListener("pointerleave", () => (this.pointer = null));
    canvas.addEventListener("dblclick", (event) => this.focus(event.clientX, event.clientY));
    canvas.addEventListener("mousedown", (event) => event.button === 1 && event.preventDefault()); // no automatic scrolling
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("keyup", (event) => this.released(event));
    canvas.addEventListener("blur", () => this.blur());
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  /** @param {PointerEvent} event */
  down(event) {
    this.motion.stop();
    this.keys.moved?.();
    this.viewer.canvas.setPointerCapture(event.pointerId);
    this.hands.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  /** @param {PointerEvent} event */
  move(event) {
    this.pointer = { x: event.clientX, y: event.clientY };
    const before = this.hands.get(event.pointerId);
    if (!before) return;
    const now = this.pointer, dx = now.x - before.x, dy = now.y - before.y;
    const others = [...this.hands].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.hands.set(event.pointerId, now);
    if (others.length) { // the distance of two fingers zooms, their midpoint pans
      const [was, is] = [before, now].map(({ x, y }) => Math.hypot(x - others[0].x, y - others[0].y));
      if (was > 1 && is > 1) this.motion.approach(was / is);
      this.motion.drag(dx / 2, dy / 2, true);
    } else this.motion.drag(dx, dy, Boolean(event.buttons & 6) || event.shiftKey);
    this.viewer.moved();
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
    this.motion.approach(Math.exp(Math.max(-400, Math.min(400, pixels)) / 900));
    this.keys.moved?.();
    this.viewer.moved();
  }

  /** Turn to what is visible at a point of the window. @param {number} x @param {number} y */
  async focus(x, y) {
    const { left, top } = this.viewer.canvas.getBoundingClientRect(), point = await this.viewer.pointAt(x - left, y - top);
    if (!point) return;
    this.keys.moved?.();
    this.motion.turnTo(point);
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key, moves = key in TURNS || key in STEPS;
    if (key === "Shift" || key === "Control") return this.motion.hurry(event.shiftKey, event.ctrlKey);
    if ((event.ctrlKey || event.metaKey || event.altKey) && !this.motion.held.has(key)) return; // a shortcut of the browser
    if (moves) {
      this.motion.press(key);
      this.keys.moved?.();
    } else if (key === "+" || key === "=" || key === "-") {
      this.motion.approach(key === "-" ? 1 / 0.9 : 0.9);
      this.keys.moved?.();
      this.viewer.moved();
    } else if (key === " ") this.keys.toggle?.();
    else if (key === "o") event.repeat || this.keys.hold?.(true);
    else if (key === "Home") this.keys.home?.();
    else if (key === "f") this.focus(...this.aim());
    else if (key === "," || key === ".") this.keys.camera?.(key === "," ? -1 : 1);
    else if (/^[1-9]$/.test(key)) this.keys.viewpoint?.(Number(key) - 1);
    else return;
    event.preventDefault();
  }

  /** Return the position of the pointer, or else of the middle. @returns {[number, number]} */
  aim() {
    const { left, top, width, height } = this.viewer.canvas.getBoundingClientRect();
    return this.pointer ? [this.pointer.x, this.pointer.y] : [left + width / 2, top + height / 2];
  }

  /** @param {KeyboardEvent} event */
  released(event) {
    this.motion.hurry(event.shiftKey, event.ctrlKey);
    this.motion.held.delete(event.key.length === 1 ? event.key.toLowerCase() : event.key);
    if (event.key.toLowerCase() === "o") this.keys.hold?.(false);
  }

  blur() {
    this.motion.stop();
    this.motion.hurry(false, false);
    this.keys.hold?.(false);
  }
}

/** @typedef {import("./vectors.js").Vector} Vector */
/** @typedef {import("./camera.js").ViewCamera} ViewCamera */

/** Turns by keys, in directions to the side and over. @type {Record<string, [number, number]>} */
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
/** Movements by keys along right, down and forward. @type {Record<string, number[]>} */
const STEPS = { a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0], w: [0, 0, 1], s: [0, 0, -1] };
/** Radians per second, and scene radii per second; factors while Shift and Ctrl are held. */
const TURN_SPEED = 1.5, SPIN_SPEED = 0.2, STEP_SPEED = 0.8, FAST = 4, SLOW = 0.25;
/** CSS pixels of a drag per radian. */
const PIXELS_PER_RADIAN = 180;
/** Milliseconds of a flight from one viewpoint to the next. */
const FLIGHT = 1500;
/** Milliseconds of turning to a point; shortest and longest time between frames, so that each press moves a little. */
const TURNING = 300, MIN_FRAME = 8, MAX_FRAME = 50;

export class Motion {
  /** @param {Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
    /** Whether to rotate about the target; otherwise about the eye. */
    this.orbit = true;
    /** @type {Set<string>} */
    this.held = new Set();
    this.factor = 1;
    /** @type {{from: Vector, to: Vector, left: number} | null} */
    this.turning = null;
    /** Flight through viewpoints: where its part starts and ends, and the viewpoints that follow. @type {{from: ViewCamera, to: ViewCamera, next: JobCamera[], left: number} | null} */
    this.flight = null;
    /** Whether the camera rotates about the scene by itself. */
    this.spinning = false;
    this.requested = 0;
    this.last = 0;
  }

  /** @param {string} key */
  press(key) {
    this.turning = this.flight = null;
    if (this.held.has(key)) return;
    this.held.add(key);
    this.start();
  }

  /** @param {boolean} fast @param {boolean} slow */
  hurry(fast, slow) {
    this.factor = (fast ? FAST : 1) * (slow ? SLOW : 1);
  }

  /** @param {Vector} point */
  turnTo(point) {
    this.stop();
    const { camera } = this.viewer;
    this.turning = { from: sum(camera.eye, times(camera.axes[2], camera.distance)), to: point, left: stillness() ? 0 : TURNING };
    this.start();
  }

  /** Move through viewpoints and stay at the last; jump if animations are unwanted. @param {JobCamera[]} viewpoints */
  fly(viewpoints) {
    this.stop();
    this.flyTo(viewpoints, stillness() && viewpoints.length < 2 ? 0 : FLIGHT);
    this.start();
    this.viewer.moved();
  }

  /** @param {JobCamera[]} viewpoints @param {number} left milliseconds until the first one is reached */
  flyTo([first, ...next], left) {
    const { camera, sides } = this.viewer, to = camera.copy();
    to.stand(first, sides?.left.scene.middle ?? null);
    this.flight = { from: camera.copy(), to, next, left };
  }

  /** Rotate about the scene until `stop`. */
  spin() {
    this.spinning = !stillness();
    this.start();
  }

  stop() {
    this.held.clear();
    this.turning = this.flight = null;
    this.spinning = false;
  }

  start() {
    if (this.requested) return;
    this.last = performance.now() - MIN_FRAME;
    this.requested = requestAnimationFrame((now) => this.step(now));
  }

  /** @param {number} now */
  step(now) {
    this.requested = 0;
    const milliseconds = Math.min(MAX_FRAME, Math.max(MIN_FRAME, now - this.last));
    this.last = now;
    if (this.viewer.ended || (!this.held.size && !this.turning && !this.flight && !this.spinning)) return;
    this.advance(milliseconds);
    this.viewer.moved();
    this.requested = requestAnimationFrame((next) => this.step(next));
  }

  /** @param {number} milliseconds */
  advance(milliseconds) {
    const { camera } = this.viewer, { turning, flight } = this, seconds = (milliseconds / 1000) * this.factor;
    for (const key of this.held) {
      if (TURNS[key]) camera.turn(TURNS[key][0] * TURN_SPEED * seconds, TURNS[key][1] * TURN_SPEED * seconds, this.orbit);
      else camera.move(times(STEPS[key], STEP_SPEED * camera.size * seconds));
    }
    if (this.spinning) camera.turn(SPIN_SPEED * seconds, 0, true);
    if (flight) {
      flight.left = Math.max(0, flight.left - milliseconds);
      const even = 1 - flight.left / FLIGHT;
      camera.between(flight.from, flight.to, stillness() ? Math.floor(even) : even * even * (3 - 2 * even));
      if (!flight.left && flight.next.length) this.flyTo(flight.next, FLIGHT);
      else if (!flight.left) this.flight = null;
    }
    if (turning) {
      turning.left = Math.max(0, turning.left - milliseconds);
      const share = 1 - (turning.left / TURNING) ** 3;
      camera.lookAt(sum(turning.from, times(difference(turning.to, turning.from), share)));
      if (!turning.left) this.turning = null;
    }
  }

  /** @param {number} dx CSS pixels @param {number} dy @param {boolean} pans */
  drag(dx, dy, pans) {
    const { camera, canvas } = this.viewer;
    if (!pans) return camera.turn(dx / PIXELS_PER_RADIAN, dy / PIXELS_PER_RADIAN, this.orbit);
    const unit = camera.distance / camera.pixels(canvas.clientWidth, canvas.clientHeight)[1];
    camera.move([-dx * unit, -dy * unit, 0]);
  }

  /** @param {number} factor */
  approach(factor) {
    const { camera } = this.viewer;
    if (this.orbit) camera.approach(factor);
    else camera.move([0, 0, (1 - factor) * camera.size]);
  }
}

/** Return whether the user wants no animations. */
const stillness = () => matchMedia("(prefers-reduced-motion: reduce)").matches;
