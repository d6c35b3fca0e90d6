// @ts-check
/** Position and orientation of the viewer's camera, and its movements. */
import { cross, difference, dot, rotated, sum, times, unit } from "./vectors.js";

/** @typedef {import("./vectors.js").Vector} Vector */
/** @typedef {import("../cameras.js").JobCamera} JobCamera */

/** Focal length of a free view as a multiple of its height: 50 degrees. */
const FOCAL = 1.07;
/** Ratio of height to width of the frame of a free view on a canvas that is narrower. */
const NARROW = 1.2;

export class ViewCamera {
  constructor() {
    /** Right, down and forward axes. @type {Vector[]} */
    this.axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    /** @type {Vector} */
    this.eye = [0, 0, -3];
    /** @type {Vector} */
    this.target = [0, 0, 0];
    /** @type {Vector} */
    this.up = [0, -1, 0];
    /** Step of a movement in world units. */
    this.size = 1;
    /** Focal lengths as multiples of the frame's height, and its aspect ratio; 0 for that of the canvas. */
    this.focal = [FOCAL, FOCAL];
    this.shape = 0;
    this.near = 0.2;
    /** Returns the principal point in pixels from the middle of a canvas. @type {(width: number, height: number) => number[]} */
    this.shift = () => [0, 0];
    this.number = 0;
  }

  /**
   * Look at a whole scene.
   *
   * @param {{center: Vector, radius: number}} middle
   * @param {Vector} up
   * @param {Vector} front direction from which to look, as far as it is level
   */
  frame({ center, radius }, up, front) {
    this.up = unit(up);
    const aside = Math.abs(dot(this.up, unit(front))) > 0.9 ? [0, -1, 0] : unit(front);
    const level = unit(difference(aside, times(this.up, dot(aside, this.up))));
    const from = unit(sum(level, times(this.up, 0.18)));
    this.size = radius;
    this.eye = sum(center, times(from, 3 * radius));
    this.focal = [FOCAL, FOCAL];
    this.shape = 0;
    this.lookAt(center);
  }

  /** Return the present pose. @returns {ViewCamera} */
  copy() {
    return Object.assign(new ViewCamera(), this);
  }

  /** Move between two poses, on an arc. @param {ViewCamera} from @param {ViewCamera} to @param {number} share 0 to 1 */
  between(from, to, share) {
    const mixed = (/** @type {Vector} */ a, /** @type {Vector} */ b) => sum(times(a, 1 - share), times(b, share));
    // the rotation from one pose to the other by its axis, which half a turn leaves open
    const turn = from.axes.map((axis, i) => cross(axis, to.axes[i])).reduce(sum), about = Math.hypot(...turn) > 1e-6 ? unit(turn) : this.up;
    const trace = from.axes.reduce((total, axis, i) => total + dot(axis, to.axes[i]), 0), angle = Math.acos(Math.max(-1, Math.min(1, (trace - 1) / 2)));
    this.axes = share === 1 ? to.axes : from.axes.map((axis) => rotated(axis, about, share * angle));
    this.target = mixed(from.target, to.target);
    this.eye = share === 1 ? to.eye : difference(this.target, times(this.axes[2], from.distance ** (1 - share) * to.distance ** share));
    this.focal = mixed(from.focal, to.focal);
    [this.shape] = mixed([from.shape || 1 / NARROW], [to.shape]);
    this.number++;
  }

  /** @param {Vector} target */
  lookAt(target) {
    this.target = target;
    const forward = unit(difference(target, this.eye)), level = cross(forward, this.up);
    const right = unit(Math.hypot(...level) > 1e-6 ? level : this.axes[0]); // straight along the up direction
    this.axes = [right, cross(forward, right), forward];
    this.number++;
  }

  /** Move to a camera of the job. @param {JobCamera} camera @param {{center: Vector, radius: number} | null} middle */
  stand(camera, middle) {
    this.eye = [...camera.position];
    this.axes = camera.axes.map((axis) => [...axis]);
    this.focal = [camera.fx / camera.height, camera.fy / camera.height];
    this.shape = camera.width / camera.height;
    const depth = middle ? dot(difference(middle.center, this.eye), this.axes[2]) : 3 * this.size;
    if (middle) this.size = middle.radius;
    this.target = sum(this.eye, times(this.axes[2], Math.max(depth, 0.3 * this.size)));
    this.number++;
  }

  /** Return focal lengths in pixels; a job's whole frame is shown. @param {number} width @param {number} height */
  pixels(width, height) {
    const frame = this.shape ? Math.min(height, width / this.shape) : Math.min(height, width * NARROW);
    return [this.focal[0] * frame, this.focal[1] * frame];
  }

  /** Return the camera of an image of this size, as jobs take it. @param {number[]} size width and height */
  ofImage([width, height]) {
    const [fx, fy] = this.pixels(width, height);
    return { width, height, fx, fy, cx: width / 2, cy: height / 2, world_to_camera: this.axes.map((axis) => [...axis, -dot(axis, this.eye)]) };
  }

  /**
   * @param {number} aside radians to the right, as if dragging the scene
   * @param {number} over radians; positive looks further down
   * @param {boolean} about whether to rotate about the target; otherwise about the eye
   */
  turn(aside, over, about) {
    const up = this.up, [right, , forward] = this.axes;
    const slant = Math.asin(Math.max(-1, Math.min(1, dot(forward, up))));
    const most = Math.max(1.5, Math.abs(slant)); // not beyond the pole
    const tilt = Math.max(-most, Math.min(most, slant - over)) - slant;
    const turned = (/** @type {Vector} */ v) => rotated(rotated(v, right, tilt), up, -aside);
    this.axes = this.axes.map(turned);
    if (about) this.eye = sum(this.target, turned(difference(this.eye, this.target)));
    else this.target = sum(this.eye, turned(difference(this.target, this.eye)));
    const f = unit(this.axes[2]), r = unit(difference(this.axes[0], times(f, dot(this.axes[0], f)))); // against accumulated rounding
    this.axes = [r, cross(f, r), f];
    this.number++;
  }

  /** @param {number} factor factor of the distance to the target */
  approach(factor) {
    const distance = this.distance * factor;
    if (distance < 1e-3 * this.size || distance > 1e3 * this.size) return;
    this.eye = sum(this.target, times(difference(this.eye, this.target), factor));
    this.number++;
  }

  /** Move eye and target. @param {number[]} by movement along right, down and forward, world units */
  move(by) {
    const step = this.axes.map((axis, i) => times(axis, by[i])).reduce(sum);
    this.eye = sum(this.eye, step);
    this.target = sum(this.target, step);
    this.number++;
  }

  get distance() {
    return Math.hypot(...difference(this.eye, this.target));
  }
}
