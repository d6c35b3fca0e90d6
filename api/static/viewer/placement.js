// @ts-check
/** Place of a scene in a room: a rotation, a size and a position, which hands and sticks change. */
import { cross, difference, dot, rotated, sum, times, unit } from "./vectors.js";

/** @typedef {import("./vectors.js").Vector} Vector */

/** Radius of a scene at first, and the height and distance of its center, in meters. */
const RADIUS = 0.6, HEIGHT = 1.2, DISTANCE = 1.4;
const UP = [0, 1, 0];

export class Placement {
  /** Meters of a world unit. */
  size = 1;
  /** Axes of the room in the scene. @type {Vector[]} */
  rows = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  /** Position of the scene's origin in the room. @type {Vector} */
  origin = [0, 0, 0];

  /**
   * Put a scene before the eyes, upright, as a camera sees it.
   *
   * @param {{center: Vector, radius: number}} middle
   * @param {{axes: Vector[], up: Vector}} camera
   */
  putBefore({ center, radius }, { axes, up }) {
    const ahead = unit(difference(axes[2], times(up, dot(axes[2], up))));
    this.rows = [cross(ahead, up), up, times(ahead, -1)];
    this.size = RADIUS / radius;
    this.origin = difference([0, HEIGHT, -DISTANCE], times(this.turned(center), this.size));
  }

  /** Turn a direction of the scene into the room. @param {Vector} direction */
  turned(direction) {
    return this.rows.map((row) => dot(row, direction));
  }

  /** Turn a direction of the room into the scene. @param {Vector} direction */
  turnedBack(direction) {
    return this.rows.map((row, i) => times(row, direction[i])).reduce(sum);
  }

  /** Return the position in the scene of a point in the room. @param {Vector} point */
  inScene(point) {
    return this.turnedBack(times(difference(point, this.origin), 1 / this.size));
  }

  /** @param {Vector} by meters */
  shift(by) {
    this.origin = sum(this.origin, by);
  }

  /** Turn about the vertical through a point. @param {number} angle radians @param {Vector} about */
  turn(angle, about) {
    const columns = [0, 1, 2].map((i) => rotated(this.rows.map((row) => row[i]), UP, angle));
    this.rows = [0, 1, 2].map((i) => columns.map((column) => column[i]));
    this.origin = sum(about, rotated(difference(this.origin, about), UP, angle));
  }

  /**
   * Follow one hand by a shift, two hands by a shift, a turn about the vertical and a change of size.
   *
   * @param {Vector[]} before positions of the hands
   * @param {Vector[]} after
   */
  follow(before, after) {
    if (!before.length) return;
    const middle = (/** @type {Vector[]} */ hands) => times(hands.reduce(sum), 1 / hands.length), from = middle(before), to = middle(after);
    if (before.length > 1) {
      const [was, is] = [difference(before[1], before[0]), difference(after[1], after[0])];
      const factor = Math.hypot(...is) / Math.max(Math.hypot(...was), 1e-3);
      this.size *= factor;
      this.origin = sum(from, times(difference(this.origin, from), factor));
      this.turn(Math.atan2(is[0], is[2]) - Math.atan2(was[0], was[2]), from);
    }
    this.shift(difference(to, from));
  }
}
