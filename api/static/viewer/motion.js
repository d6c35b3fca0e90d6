// @ts-check
/** Movements of the camera that last: keys that are held, gliding after a drag, and turning to a point. */
import { difference, sum, times } from "./vectors.js";

/** @typedef {import("./viewer.js").Viewer} Viewer */
/** @typedef {import("./vectors.js").Vector} Vector */

/** Turns by keys, in directions to the side and over. @type {Record<string, [number, number]>} */
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
/** Movements by keys along right, down and forward. @type {Record<string, number[]>} */
const STEPS = { a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0], w: [0, 0, 1], s: [0, 0, -1] };
/** Radians per second, and scene radii per second; factors while Shift and Ctrl are held. */
const TURN_SPEED = 1.5, SPIN_SPEED = 0.2, STEP_SPEED = 0.8, FAST = 4, SLOW = 0.25;
/** CSS pixels of a drag per radian. */
const PIXELS_PER_RADIAN = 180;
/** Milliseconds in which a glide loses two thirds of its speed, and speed in CSS pixels per millisecond where it ends. */
const GLIDE = 130, END = 0.02;
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
    /** @type {{x: number, y: number, pans: boolean} | null} */
    this.speed = null;
    /** @type {{from: Vector, to: Vector, left: number} | null} */
    this.turning = null;
    /** Whether the camera rotates about the scene by itself. */
    this.spinning = false;
    this.requested = 0;
    this.last = 0;
  }

  /** @param {string} key */
  moves(key) {
    return key in TURNS || key in STEPS;
  }

  /** @param {string} key */
  press(key) {
    this.turning = null;
    if (this.held.has(key)) return;
    this.held.add(key);
    this.start();
  }

  /** @param {string} key */
  release(key) {
    this.held.delete(key);
  }

  /** @param {boolean} fast @param {boolean} slow */
  hurry(fast, slow) {
    this.factor = (fast ? FAST : 1) * (slow ? SLOW : 1);
  }

  /**
   * Let the scene glide after a drag.
   *
   * @param {number} x CSS pixels per millisecond
   * @param {number} y
   * @param {boolean} pans
   */
  glide(x, y, pans) {
    if (Math.hypot(x, y) < END || stillness()) return;
    this.speed = { x, y, pans };
    this.start();
  }

  /** @param {Vector} point */
  turnTo(point) {
    this.stop();
    const { camera } = this.viewer;
    this.turning = { from: sum(camera.eye, times(camera.axes[2], camera.distance)), to: point, left: stillness() ? 0 : TURNING };
    this.start();
  }

  /** Rotate about the scene until `stop`. */
  spin() {
    this.spinning = !stillness();
    this.start();
  }

  stop() {
    this.held.clear();
    this.speed = this.turning = null;
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
    if (this.viewer.ended || (!this.held.size && !this.speed && !this.turning && !this.spinning)) return;
    this.advance(milliseconds);
    this.viewer.moved();
    this.requested = requestAnimationFrame((next) => this.step(next));
  }

  /** @param {number} milliseconds */
  advance(milliseconds) {
    const { camera } = this.viewer, { speed, turning } = this, seconds = (milliseconds / 1000) * this.factor;
    for (const key of this.held) {
      if (TURNS[key]) camera.turn(TURNS[key][0] * TURN_SPEED * seconds, TURNS[key][1] * TURN_SPEED * seconds, this.orbit);
      else camera.move(times(STEPS[key], STEP_SPEED * camera.size * seconds));
    }
    if (this.spinning) camera.turn(SPIN_SPEED * seconds, 0, true);
    if (speed) {
      this.drag(speed.x * milliseconds, speed.y * milliseconds, speed.pans);
      const rest = Math.exp(-milliseconds / GLIDE);
      [speed.x, speed.y] = [speed.x * rest, speed.y * rest];
      if (Math.hypot(speed.x, speed.y) < END) this.speed = null;
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
