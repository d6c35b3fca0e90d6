// @ts-check
/** Viewer of one or two scenes with two color sets and a wipe between them. It draws only after a change. */
import { ViewCamera } from "./camera.js";
import { Painter } from "./painter.js";
import { gaussianAt, pickedView } from "./pick_pass.js";
import { SplatScene } from "./splat_scene.js";
import { words } from "../words.js";

/** @typedef {{colors: string, weight: number}} Part color set of a blend; the weights of all parts add up to 1 */
/** @typedef {{scene: SplatScene, colors: string, fade?: number, blend?: Part[]}} Side what is shown on one side of the wipe; a `blend` of up to three color sets replaces `colors` */

/** Milliseconds of a frame above which a moving view is drawn at a half, or at a quarter, of the resolution. */
const SLOW = 70, VERY_SLOW = 350;
/** Milliseconds without movement after which the full resolution is drawn. */
const STILL = 160;
/** Least time between two frames that nobody asked for, in durations of a frame. */
const REST = 10;

export class Viewer {
  /** The scene bounds that the camera was last set to show. @type {SplatScene["middle"]} */
  framed = null;

  told = () => {};

  onReload = () => {};

  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.camera = new ViewCamera();
    /** @type {{left: Side, right: Side} | null} */
    this.sides = null;
    /** Fraction of the width that shows the left side. */
    this.cut = 0;
    this.background = [0, 0, 0];
    /** Lines in the world, as pairs of points [n * 2 * 3]. */
    this.lines = new Float32Array(0);
    this.touched = false;
    this.frames = 0;
    /** GPU times of the last frames in milliseconds. @type {number[]} */
    this.milliseconds = [];
    /** Width and height of the canvas in pixels while a view is frozen. @type {number[] | null} */
    this.frozen = null;
    this.lost = false;
    this.ended = false;
    /** The headset that shows the scene instead of the canvas. @type {import("./headset.js").Headset | null} */
    this.headset = null;
    this.scale = 1;
    this.movingScale = 1;
    this.movedAt = 0;
    this.requested = 0;
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error(words.viewer.noWebGL);
    this.gl = gl;
    this.painter = new Painter(this);
    /** @type {WebGLSync | null} */
    this.fence = null;
    this.leaving = new AbortController();
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.lost = true;
      canvas.dataset.state = "lost";
      this.told();
    }, { signal: this.leaving.signal });
    canvas.addEventListener("webglcontextrestored", () => this.restore(), { signal: this.leaving.signal });
    this.resized = new ResizeObserver(() => this.draw());
    this.resized.observe(canvas);
  }

  /** Start to read a scene. It is shown once it is on a side of the wipe. @param {File | string} source */
  open(source) {
    return new SplatScene(this.gl, source, () => this.sceneChanged());
  }

  sceneChanged() {
    const middle = this.sides?.left.scene.middle;
    if (middle && !this.touched && !this.camera.shape && middle !== this.framed) {
      this.framed = middle;
      this.frame(this.camera.up);
    }
    this.told();
    this.draw();
  }

  /** Look at the whole scene. @param {number[]} up @param {number[]} [front] by default that of the format */
  frame(up, front) {
    const scene = this.sides?.left.scene;
    if (scene?.middle) this.camera.frame(scene.middle, up, front ?? scene.front);
  }

  /** Show the whole scene, as before the first movement of the camera. @param {number[]} [front] see `frame` */
  reframe(front) {
    this.touched = false;
    this.camera.shape = 0;
    this.framed = this.sides?.left.scene.middle ?? null;
    this.frame(this.camera.up, front);
    this.draw();
  }

  /** @param {Side} left @param {Side} right */
  show(left, right = left) {
    this.sides = { left, right };
    this.sceneChanged();
  }

  /** @param {number} share */
  wipe(share) {
    this.cut = share;
    this.draw();
  }

  /** Update after a movement of the camera. */
  moved() {
    this.touched = true;
    this.movedAt = performance.now();
    this.draw();
  }

  draw() {
    this.settled = false;
    this.canvas.dataset.state = "drawing";
    if (!this.requested && !this.ended) this.later();
  }

  later() {
    this.requested = requestAnimationFrame(() => this.step());
  }

  /** Draw a frame once the last one is finished, or stop if that one shows everything. */
  step() {
    this.requested = 0;
    if (this.lost || this.ended || this.headset) return;
    if (!this.finished()) return this.later();
    if (this.settled) {
      this.canvas.dataset.state = this.sides?.left.scene.whole && this.sides.right.scene.whole ? "settled" : "loading";
      return this.told();
    }
    const again = this.askForOrder();
    this.scale = performance.now() - this.movedAt < STILL ? this.movingScale : 1;
    this.painter.render();
    this.begun = performance.now();
    this.fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
    this.frames++;
    this.settled = !again && this.scale === 1 && this.sides !== null;
    if (this.sides) this.later();
  }

  /** Return whether a frame now would leave the machine little time for other work, such as the job that is watched. */
  crowded() {
    return performance.now() - (this.begun ?? -Infinity) < REST * (this.milliseconds.at(-1) ?? 0);
  }

  /** Return whether the GPU has finished the last frame. */
  finished() {
    const { gl } = this;
    if (!this.fence) return true;
    const state = gl.clientWaitSync(this.fence, 0, 0);
    if (state === gl.TIMEOUT_EXPIRED) return false;
    gl.deleteSync(this.fence);
    this.fence = null;
    const took = performance.now() - (this.begun ?? 0);
    this.milliseconds.push(took);
    if (this.milliseconds.length > 100) this.milliseconds.shift();
    if (this.scale === 1) this.movingScale = took > VERY_SLOW ? 0.25 : took > SLOW ? 0.5 : 1;
    return true;
  }

  /** Request depth orders for this view, and return whether the displayed order is out of date. */
  askForOrder() {
    if (!this.sides) return false;
    let waiting = false;
    for (const scene of new Set([this.sides.left.scene, this.sides.right.scene])) {
      const stale = scene.loaded > 0 && (scene.sortedFor !== this.poseNumber() || scene.sortedOf < scene.loaded);
      if (stale) scene.sort(this.pose(), this.poseNumber());
      waiting ||= stale;
    }
    return waiting;
  }

  poseNumber() {
    const [width, height] = this.size();
    return this.camera.number * 1e6 + ((width * 31 + height) % 1e6);
  }

  pose() {
    const [width, height] = this.size(), [fx, fy] = this.camera.pixels(width, height);
    return { axes: this.camera.axes, eye: this.camera.eye, tan: [width / 2 / fx, height / 2 / fy], near: this.camera.near };
  }

  /** Return the size of the canvas in pixels. */
  size() {
    if (this.frozen) return this.frozen;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    return [Math.max(1, Math.round(this.canvas.clientWidth * ratio)), Math.max(1, Math.round(this.canvas.clientHeight * ratio))];
  }

  /** Return the current view as a PNG. @returns {Promise<Blob>} */
  picturePng() {
    this.scale = 1;
    this.painter.render(); // a canvas drops its content when the task ends
    return new Promise((done, wrong) => this.canvas.toBlob((blob) => (blob ? done(blob) : wrong(new Error(words.viewer.noPicture))), "image/png"));
  }

  /** Return the center of what is seen near a point, or null. @param {number} x CSS pixels @param {number} y */
  async pointAt(x, y) {
    const view = pickedView(this), { clientWidth, clientHeight } = this.canvas;
    const index = view ? gaussianAt(view, (x * view.width) / clientWidth, (y * view.height) / clientHeight) : -1;
    return index < 0 ? null : /** @type {Side} */ (this.sides?.left).scene.centerOf(index);
  }

  /** Reload everything after a lost GPU context is restored. */
  restore() {
    this.lost = false;
    this.painter = new Painter(this);
    this.fence = null;
    this.framed = null;
    const before = this.sides;
    this.sides = null;
    if (before) this.onReload();
    this.told();
  }

  end() {
    this.ended = true;
    cancelAnimationFrame(this.requested);
    this.resized.disconnect();
    this.leaving.abort();
    for (const scene of new Set([this.sides?.left.scene, this.sides?.right.scene])) scene?.end();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}
