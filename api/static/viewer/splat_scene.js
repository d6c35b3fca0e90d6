// @ts-check
/** A scene on the GPU: geometry and harmonics once, and any number of color sets. */
import { harmonicTexels } from "./packing.js";
import { words } from "../words.js";

/** @typedef {{center: number[], radius: number, low: number[], high: number[]}} Middle */
/** @typedef {{count: number, degree: number, size: number, rendering: import("./render_tag.js").Rendering, front?: number[]}} Shown values of a file's header */

/** @typedef {import("./depth_order.js").Pose} Pose */
/** @typedef {Error & {cut: boolean}} SceneFailure `cut`: whether the file ends too early */

/** Direction from which a scene is seen first: that of the cameras that its own axes suggest. */
export const FRONT = [0, 0, -1];
/** Maximum bytes of textures; lower on devices with little memory, such as phones. */
const MEMORY = (/** @type {any} */ (navigator).deviceMemory ?? 8) >= 8 ? 1.5e9 : 4e8;

export class SplatScene {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {File | string} source
   * @param {() => void} changed called when there is more to draw
   * @param {number} memory maximum bytes of textures
   */
  constructor(gl, source, changed, memory = MEMORY) {
    this.gl = gl;
    this.source = source;
    this.changed = changed;
    /** @type {Shown | null} */
    this.header = null;
    this.degree = 0;
    this.front = FRONT;
    this.loaded = 0;
    /** @type {Middle | null} */
    this.middle = null;
    this.whole = false;
    /** Number of Gaussians that the last order includes, and number that it draws. */
    this.sortedOf = 0;
    this.drawn = 0;
    /** @type {Map<string, WebGLTexture>} */
    this.colors = new Map();
    /** Flags of Gaussians to highlight; null for none. @type {WebGLTexture | null} */
    this.marks = null;
    /** Called with the worker's answers to changes of the selection. @type {((changed: import("./selection.js").Changed) => void) | undefined} */
    this.onSelected = undefined;
    /** Functions that take the answers to requests for centers. @type {((center: number[]) => void)[]} */
    this.centers = [];
    this.order = gl.createBuffer();
    this.room = 0;
    this.busy = false;
    /** @type {Promise<Shown>} */
    this.headerRead = new Promise((found, wrong) => { this.tellHeader = found; this.tellWrong = wrong; });
    /** @type {Promise<void>} */
    this.ready = new Promise((done, wrong) => { this.tellReady = done; this.tellBroken = wrong; });
    this.headerRead.catch(() => {});
    this.ready.catch(() => {});
    const largest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.bits = largest >= 8192 ? 13 : 12;
    this.worker = new Worker(new URL("./scene_worker.js", import.meta.url), { type: "module" });
    this.worker.onmessage = ({ data }) => this.heard(data);
    this.worker.onerror = () => this.fail(words.scene.unreadable);
    this.worker.postMessage({ kind: "load", source, room: { texels: (1 << this.bits) * Math.min(largest, 16384), bytes: memory } });
  }

  /** @param {any} told */
  heard(told) {
    if (this.gl.isContextLost()) return;
    if (told.kind === "header") this.allocate(told.header, told.degree);
    else if (told.kind === "batch") this.take(told);
    else if (told.kind === "order") this.takeOrder(told);
    else if (told.kind === "center") this.centers.shift()?.(told.center);
    else if (told.kind === "selected") this.onSelected?.(told);
    else if (told.kind === "done") {
      this.whole = true;
      this.middle = told.middle;
      this.tellReady?.();
    } else this.fail(told.message, told.cut);
    this.changed();
  }

  /** @param {string} message @param {boolean} [cut] whether the file ends too early */
  fail(message, cut = false) {
    const wrong = Object.assign(new Error(message), { cut });
    this.tellWrong?.(wrong);
    this.tellBroken?.(wrong);
  }

  /** @param {Shown} header @param {number} degree */
  allocate(header, degree) {
    const { gl } = this;
    this.header = header;
    this.front = header.front ?? FRONT;
    this.degree = degree;
    this.texels = harmonicTexels(degree);
    this.geometry = this.texture(gl.RGBA32UI, 2 * header.count);
    this.harmonics = degree ? this.texture(gl.RGBA32UI, this.texels * header.count) : this.geometry;
    this.colors.set("own", this.texture(gl.RGB16F, header.count));
    this.tellHeader?.(header);
  }

  /** @param {number} form @param {number} texels */
  texture(form, texels) {
    const { gl } = this, made = gl.createTexture(), width = 1 << this.bits;
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texStorage2D(gl.TEXTURE_2D, 1, form, width, Math.ceil(texels / width));
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    return made;
  }

  /** @param {{begin: number, count: number, geometry: Uint32Array, colors: Uint16Array, harmonics: Uint16Array, middle?: Middle}} batch */
  take({ begin, count, geometry, colors, harmonics, middle }) {
    const { gl } = this;
    this.fill(this.geometry, begin * 2, geometry, gl.RGBA_INTEGER, gl.UNSIGNED_INT, 4);
    this.fill(this.colors.get("own"), begin, colors, gl.RGB, gl.HALF_FLOAT, 3);
    if (this.degree) this.fill(this.harmonics, begin * (this.texels ?? 0), new Uint32Array(harmonics.buffer), gl.RGBA_INTEGER, gl.UNSIGNED_INT, 4);
    this.middle = middle ?? this.middle;
    this.loaded = begin + count;
  }

  /**
   * Upload texels to a texture: whole rows first, then the rest of the last one.
   *
   * @param {WebGLTexture | null | undefined} texture
   * @param {number} begin first texel, at the start of a row
   * @param {Uint32Array | Uint16Array | Uint8Array} data
   * @param {number} form
   * @param {number} type
   * @param {number} parts values of a texel
   */
  fill(texture, begin, data, form, type, parts) {
    const { gl } = this, width = 1 << this.bits, texels = data.length / parts, rows = Math.floor(texels / width), left = texels - rows * width;
    gl.bindTexture(gl.TEXTURE_2D, texture ?? null);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 2);
    const row = begin >> this.bits;
    if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, rows, form, type, data);
    if (left) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row + rows, left, 1, form, type, data.subarray(rows * width * parts));
  }

  /** Add or replace a color set: three halves each. @param {string} name @param {ReadableStream<Uint8Array>} stream */
  async addColors(name, stream) {
    await this.headerRead;
    const { gl } = this, count = this.header?.count ?? 0, bytes = await new Response(stream).arrayBuffer();
    if (bytes.byteLength !== count * 6) throw new Error(words.scene.otherColors);
    const texture = this.colors.get(name) ?? this.texture(gl.RGB16F, count);
    this.fill(texture, 0, new Uint16Array(bytes), gl.RGB, gl.HALF_FLOAT, 3);
    this.colors.set(name, texture);
    this.changed();
  }

  /** Return the center of a Gaussian. @param {number} index @returns {Promise<number[]>} */
  centerOf(index) {
    this.worker.postMessage({ kind: "center", index });
    return new Promise((done) => this.centers.push(done));
  }

  /** Request a depth order, unless one is being computed. @param {Pose} pose @param {number} number that of the pose */
  sort(pose, number) {
    if (this.busy || !this.loaded) return;
    this.busy = true;
    this.worker.postMessage({ kind: "sort", pose, number });
  }

  /** @param {{order: Uint32Array, number: number, of: number}} told */
  takeOrder({ order, number, of }) {
    const { gl } = this;
    this.busy = false;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    if (order.length > this.room) {
      this.room = Math.ceil(order.length * 1.25);
      gl.bufferData(gl.ARRAY_BUFFER, this.room * 4, gl.DYNAMIC_DRAW);
    }
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
    this.drawn = order.length;
    this.sortedOf = of;
    this.sortedFor = number;
  }

  end() {
    this.worker.terminate();
    const { gl } = this;
    for (const texture of new Set([this.geometry, this.harmonics, this.marks, ...this.colors.values()])) gl.deleteTexture(texture ?? null);
    gl.deleteBuffer(this.order);
  }
}
