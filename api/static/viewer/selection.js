// @ts-check
/** Selection of a scene's Gaussians: requests to the scene's worker, and a texture that highlights the selected ones. */
import { pickedView } from "./pick_pass.js";

/** @typedef {{begin: number, flags: Uint8Array, total: number, past: number, future: number, bits?: Uint8Array}} Changed `total`: selected Gaussians; `past` and `future`: changes that can be undone and redone */

/** Gaussians in the longest row of a texture; updates start at a multiple of it. */
const ROW = 8192;

export class Selection {
  /**
   * @param {import("./viewer.js").Viewer} viewer
   * @param {import("./splat_scene.js").SplatScene} scene a scene that is completely loaded
   * @param {(changed: Changed) => void} told called after each change
   */
  constructor(viewer, scene, told) {
    this.viewer = viewer;
    this.scene = scene;
    this.told = told;
    this.count = scene.header?.count ?? 0;
    this.flags = new Uint8Array(this.count);
    /** Pose that the worker knows, and size of its image. */
    this.pose = -1;
    this.size = [1, 1];
    /** @type {((changed: Changed) => void)[]} */
    this.waiting = [];
    scene.marks = scene.texture(viewer.gl.R8UI, this.count);
    scene.fill(scene.marks, 0, this.flags, viewer.gl.RED_INTEGER, viewer.gl.UNSIGNED_BYTE, 1);
    scene.onSelected = (changed) => this.take(changed);
  }

  /**
   * Send a request to the worker, which answers in order.
   *
   * @param {string} op see `Selector.change`
   * @param {Record<string, any>} [values]
   * @param {Transferable[]} [moved]
   * @returns {Promise<Changed>}
   */
  ask(op, values = {}, moved = []) {
    this.scene.worker.postMessage({ kind: "select", op, ...values }, moved);
    return new Promise((done) => this.waiting.push(done));
  }

  /** @param {Changed} changed */
  take(changed) {
    const { begin, flags } = changed, { gl } = this.viewer;
    if (flags.length) {
      this.flags.set(flags, begin);
      const first = Math.floor(begin / ROW) * ROW;
      this.scene.fill(this.scene.marks, first, this.flags.subarray(first, begin + flags.length), gl.RED_INTEGER, gl.UNSIGNED_BYTE, 1);
    }
    this.waiting.shift()?.(changed);
    this.told(changed);
  }

  /** Let the worker know which Gaussians the current view shows. */
  look() {
    const { viewer } = this, pose = viewer.poseNumber();
    if (pose === this.pose) return;
    const view = pickedView(viewer);
    if (!view) return;
    if (this.scene.sortedFor === pose) this.pose = pose;
    this.size = [view.width, view.height];
    this.ask("view", view, [view.ids.buffer]);
  }

  /** Return a point of the canvas in pixels of the worker's view. @param {number} x CSS pixels @param {number} y */
  point(x, y) {
    const { clientWidth, clientHeight } = this.viewer.canvas;
    return [(x * this.size[0]) / clientWidth, (y * this.size[1]) / clientHeight];
  }

  end() {
    this.viewer.gl.deleteTexture(this.scene.marks ?? null);
    this.scene.marks = null;
    this.scene.onSelected = undefined;
    this.viewer.draw();
  }
}
