// @ts-check
/** Stereo view in a headset (WebXR): one depth order for both eyes. Hands and sticks move the room around the scene. */
import { words } from "../words.js";
import { cross, difference, dot, rotated, sum, times, unit } from "./vectors.js";

/** @typedef {import("./vectors.js").Vector} Vector */
/** @typedef {import("./viewer.js").Viewer} Viewer */
/** @typedef {import("./viewer.js").Side} Side */
/** @typedef {"immersive-vr" | "immersive-ar"} Mode */

/** Seconds of a frame above which the next ones have fewer pixels, and below which they have more again. */
const SLOW = 1 / 65, FAST = 1 / 71;
/** Smallest fraction of the headset's pixels in each direction, and change of it after a slow frame. */
const LEAST_SCALE = 0.4, SCALE_STEP = 0.05;
/** Distance in meters below which nothing is drawn. */
const NEAR = 0.05;
/** Factor by which the sorted part of the scene is wider than the view: heads turn faster than mice. */
const WIDER = 1.5;
/** Meters and radians per second at full deflection of a stick, and share of the blend. */
const WALK = 1.5, TURN = 1.6, BLEND = 0.8;
/** Deflection below which a stick rests. */
const REST = 0.15;
/** Radius in meters and corners of the ring where a hand points at the floor. */
const RING = 0.25, CORNERS = 24;
/** Buttons of the standard layout of controllers. */
const TRIGGER = 0, GRIP = 1, LOWER_BUTTON = 4;

/** Return whether this device can show scenes in a mode. @param {Mode} mode */
export async function canShow(mode) {
  return (await /** @type {any} */ (navigator).xr?.isSessionSupported(mode).catch(() => false)) === true;
}

export class Headset {
  /** @param {Viewer} viewer @param {Mode} mode @param {() => void} ended called after the session has ended */
  constructor(viewer, mode, ended) {
    this.viewer = viewer;
    this.mode = mode;
    this.ended = ended;
    this.own = viewer.camera;
    this.placement = new Placement();
    /** Fraction of the right side's colors, between the sides' color sets. */
    this.share = 1;
    this.scale = 1;
    this.sortNumber = 0;
    this.last = 0;
    /** Positions of the gripping hands in the last frame. @type {Map<string, Vector>} */
    this.grips = new Map();
    /** Rays of the hands whose trigger is pressed. @type {Map<string, {from: Vector, floor: Vector}>} */
    this.rays = new Map();
  }

  /** Start the session. It must be called in answer to a click. */
  async start() {
    const { viewer, mode } = this, { gl } = viewer, middle = viewer.sides?.left.scene.middle;
    if (!middle) throw new Error(words.viewer.notLoadedYet);
    this.session = await /** @type {any} */ (navigator).xr.requestSession(mode, { optionalFeatures: ["local-floor"] });
    this.session.addEventListener("end", () => this.finish());
    await /** @type {any} */ (gl).makeXRCompatible();
    this.layer = new /** @type {any} */ (globalThis).XRWebGLLayer(this.session, gl, { antialias: false, depth: false });
    if ("fixedFoveation" in this.layer) this.layer.fixedFoveation = 1;
    await this.session.updateRenderState({ baseLayer: this.layer });
    this.space = await this.session.requestReferenceSpace("local-floor").catch(() => this.session.requestReferenceSpace("local"));
    this.placement.putBefore(middle, this.own);
    viewer.headset = this;
    this.session.requestAnimationFrame((/** @type {number} */ time, /** @type {any} */ frame) => this.draw(time, frame));
  }

  end() {
    return this.session?.end();
  }

  finish() {
    const { viewer } = this;
    viewer.headset = null;
    viewer.camera = this.own;
    viewer.camera.number++; // the depth order is that of the headset
    viewer.draw();
    this.ended();
  }

  /** @param {number} time milliseconds @param {any} frame XRFrame */
  draw(time, frame) {
    const { viewer, session } = this;
    session.requestAnimationFrame((/** @type {number} */ t, /** @type {any} */ f) => this.draw(t, f));
    const seconds = this.last ? Math.min((time - this.last) / 1000, 0.1) : 0, pose = frame.getViewerPose(this.space);
    this.last = time;
    if (!pose || !viewer.sides || viewer.lost) return;
    if (seconds > SLOW) this.scale = Math.max(LEAST_SCALE, this.scale - SCALE_STEP);
    else if (seconds && seconds < FAST) this.scale = Math.min(1, this.scale + SCALE_STEP / 20);
    this.move(frame, pose, seconds);
    const eyes = pose.views.map((/** @type {any} */ view) => this.eye(view));
    this.sort(eyes);
    viewer.painter.renderEyes(this.layer, eyes, this.sides(), this.scale, this.lines(), this.mode === "immersive-ar");
    viewer.frames++;
  }

  /** Return the camera of an eye in the scene, with its part of the frame. @param {any} view XRView */
  eye(view) {
    const { x, y, width, height } = this.layer.getViewport(view), m = view.transform.matrix, p = view.projectionMatrix;
    const column = (/** @type {number} */ i) => [m[4 * i], m[4 * i + 1], m[4 * i + 2]];
    const axes = [column(0), times(column(1), -1), times(column(2), -1)].map((axis) => this.placement.turnedBack(axis));
    return {
      axes, eye: this.placement.inScene(column(3)), near: NEAR / this.placement.size, size: 1 / this.placement.size, viewport: [x, y, width, height],
      pixels: (/** @type {number} */ w, /** @type {number} */ h) => [(p[0] * w) / 2, (p[5] * h) / 2],
      shift: (/** @type {number} */ w, /** @type {number} */ h) => [(-p[8] * w) / 2, (p[9] * h) / 2],
      tan: [(1 + Math.abs(p[8])) / p[0], (1 + Math.abs(p[9])) / p[5]],
    };
  }

  /** Request the depth order of the point between the eyes. @param {any[]} eyes */
  sort(eyes) {
    const middle = times(eyes.map(({ eye }) => eye).reduce(sum), 1 / eyes.length), { axes, near } = eyes[0];
    const tan = [0, 1].map((i) => WIDER * Math.max(...eyes.map((eye) => eye.tan[i])));
    const { left, right } = /** @type {{left: Side, right: Side}} */ (this.viewer.sides);
    for (const scene of new Set([left.scene, right.scene])) scene.sort({ axes, eye: middle, tan, near }, --this.sortNumber);
  }

  /** Return the sides: both have the blend if they are color sets of one scene, and the original while a button is held. */
  sides() {
    const { left, right } = /** @type {{left: Side, right: Side}} */ (this.viewer.sides);
    if (this.original) return { left, right: left };
    if (left.scene !== right.scene) return this.share < 0.5 ? { left, right: left } : { left: right, right };
    const parts = (/** @type {Side} */ side, /** @type {number} */ share) =>
      (side.blend ?? [{ colors: side.colors, weight: 1 }]).map(({ colors, weight }) => ({ colors, weight: weight * share }));
    const fade = (left.fade ?? 0) * (1 - this.share) + (right.fade ?? 0) * this.share;
    const blend = merged([...parts(left, 1 - this.share), ...parts(right, this.share)]);
    const side = { scene: left.scene, colors: left.colors, fade, blend };
    return { left: side, right: side };
  }

  /** Move as hands, sticks and buttons ask for. @param {any} frame @param {any} pose @param {number} seconds */
  move(frame, pose, seconds) {
    const head = vector(pose.transform.position), grips = new Map(), rays = new Map();
    this.original = false;
    for (const source of this.session.inputSources) {
      const { gamepad, handedness, gripSpace, targetRaySpace } = source;
      if (!gamepad) continue;
      const pressed = (/** @type {number} */ button) => gamepad.buttons[button]?.pressed === true;
      const [x, y] = gamepad.axes.slice(-2).map((/** @type {number} */ value) => (Math.abs(value) < REST ? 0 : value));
      if (handedness === "left") {
        const m = pose.transform.matrix, flat = Math.hypot(m[8], m[10]) || 1;
        const back = [m[8] / flat, 0, m[10] / flat], right = [back[2], 0, -back[0]];
        this.placement.shift(times(sum(times(right, x), times(back, y)), -WALK * seconds));
      } else {
        this.placement.turn(x * TURN * seconds, head);
        this.share = Math.max(0, Math.min(1, this.share - y * BLEND * seconds));
      }
      this.original ||= pressed(LOWER_BUTTON);
      const held = pressed(GRIP) && gripSpace && frame.getPose(gripSpace, this.space);
      if (held) grips.set(handedness, vector(held.transform.position));
      const ray = pressed(TRIGGER) && rayOf(frame.getPose(targetRaySpace, this.space));
      if (ray) rays.set(handedness, ray);
      const before = this.rays.get(handedness);
      if (before && !pressed(TRIGGER)) this.placement.shift([head[0] - before.floor[0], 0, head[2] - before.floor[2]]);
    }
    this.rays = rays;
    const both = [...grips.keys()].filter((hand) => this.grips.has(hand));
    this.placement.follow(both.map((hand) => /** @type {Vector} */ (this.grips.get(hand))), both.map((hand) => grips.get(hand)));
    this.grips = grips;
  }

  /** Return the rays, with rings where they reach the floor, as pairs of points in the scene. */
  lines() {
    const points = [...this.rays.values()].flatMap(({ from, floor }) => {
      const corner = (/** @type {number} */ i) => sum(floor, [RING * Math.cos((2 * Math.PI * i) / CORNERS), 0, RING * Math.sin((2 * Math.PI * i) / CORNERS)]);
      return [from, floor, ...Array.from({ length: CORNERS }, (_, i) => [corner(i), corner(i + 1)]).flat()];
    });
    return Float32Array.from(points.flatMap((point) => this.placement.inScene(point)));
  }
}

/** Return where a hand's ray starts and reaches the floor; null if it does not. @param {any} pose XRPose */
function rayOf(pose) {
  if (!pose) return null;
  const m = pose.transform.matrix, from = [m[12], m[13], m[14]], along = [-m[8], -m[9], -m[10]];
  return along[1] < -0.05 && from[1] > 0 ? { from, floor: sum(from, times(along, from[1] / -along[1])) } : null;
}

/** @param {{x: number, y: number, z: number}} position @returns {Vector} */
const vector = ({ x, y, z }) => [x, y, z];

/** Add up the weights of equal color sets. @param {import("./viewer.js").Part[]} parts */
function merged(parts) {
  /** @type {Map<string, number>} */
  const weights = new Map();
  for (const { colors, weight } of parts) weights.set(colors, (weights.get(colors) ?? 0) + weight);
  return [...weights].map(([colors, weight]) => ({ colors, weight }));
}

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

  /** Follow one hand by a shift, two also by a turn and a size. @param {Vector[]} before hands @param {Vector[]} now */
  follow(before, now) {
    if (!before.length) return;
    const middle = (/** @type {Vector[]} */ hands) => times(hands.reduce(sum), 1 / hands.length), from = middle(before), to = middle(now);
    if (before.length > 1) {
      const [was, is] = [difference(before[1], before[0]), difference(now[1], now[0])];
      const factor = Math.hypot(...is) / Math.max(Math.hypot(...was), 1e-3);
      this.size *= factor;
      this.origin = sum(from, times(difference(this.origin, from), factor));
      this.turn(Math.atan2(is[0], is[2]) - Math.atan2(was[0], was[2]), from);
    }
    this.shift(difference(to, from));
  }
}
