// @ts-check
/** Viewer of one or two scenes with two color sets and a wipe between them. It draws only after a change. */
import { ViewCamera } from "./camera.js";
import { gaussianAt, PickPass } from "./pick_pass.js";
import { CLASSIC } from "./render_tag.js";
import { lineFragment, lineVertex, overBackground, splatFragment, splatVertex, wholeVertex } from "./shaders.js";
import { SplatScene } from "./splat_scene.js";
import { words } from "../words.js";

/** @typedef {{colors: string, weight: number}} Part color set of a blend; the weights of all parts add up to 1 */
/** @typedef {{scene: SplatScene, colors: string, fade?: number, blend?: Part[]}} Side what is shown on one side of the wipe; a `blend` of up to three color sets replaces `colors` */
/** @typedef {{program: WebGLProgram, at: (name: string) => WebGLUniformLocation | null}} Program */

/** Milliseconds of a frame above which a moving view is drawn at a half, or at a quarter, of the resolution. */
const SLOW = 70, VERY_SLOW = 350;
/** Milliseconds without movement after which the full resolution is drawn. */
const STILL = 160;
/** Fraction of the highlight's color in highlighted Gaussians, and texture unit of the marks. */
const HIGHLIGHT = 0.6, MARKS_UNIT = 10;
/** Color of lines, and their opacity. */
const INK = [0.98, 0.6, 0.28, 0.55];

export class Viewer {
  /** Programs by degree of harmonics and size of their textures. @type {Map<number, Program>} */
  splatPrograms = new Map();
  /** Framebuffer for blending. @type {WebGLFramebuffer | null} */
  frame = null;
  /** @type {WebGLTexture | null} */
  picture = null;
  pictureSize = [0, 0];
  /** The scene bounds that the camera was last set to show. @type {SplatScene["middle"]} */
  framed = null;

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {() => void} told called after each change of the state
   */
  constructor(canvas, told = () => {}) {
    this.canvas = canvas;
    this.told = told;
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
    this.prepare();
    this.onLost = (/** @type {Event} */ event) => this.lose(event);
    this.onRestored = () => this.restore();
    canvas.addEventListener("webglcontextlost", this.onLost);
    canvas.addEventListener("webglcontextrestored", this.onRestored);
    this.resized = new ResizeObserver(() => this.draw());
    this.resized.observe(canvas);
  }

  prepare() {
    const { gl } = this;
    this.exact = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    gl.getExtension("OES_texture_float_linear");
    this.splatPrograms = new Map();
    this.compose = this.program(wholeVertex, overBackground);
    this.line = this.program(lineVertex, lineFragment);
    this.corners = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    this.lineBuffer = gl.createBuffer();
    this.frame = gl.createFramebuffer();
    this.picture = null;
    this.pictureSize = [0, 0];
    /** @type {WebGLSync | null} */
    this.fence = null;
  }

  /**
   * @param {string} vertex
   * @param {string} fragment
   * @returns {Program}
   */
  program(vertex, fragment) {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, text] of /** @type {[number, string][]} */ ([[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]])) {
      const shader = /** @type {WebGLShader} */ (gl.createShader(kind));
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(program) ?? "shader");
    /** @type {Map<string, WebGLUniformLocation | null>} */
    const found = new Map();
    const at = (/** @type {string} */ name) => {
      if (!found.has(name)) found.set(name, gl.getUniformLocation(program, name));
      return found.get(name) ?? null;
    };
    return { program, at };
  }

  /**
   * Start to read a scene. It is shown once it is on a side of the wipe.
   *
   * @param {File | string} source
   */
  open(source) {
    return new SplatScene(this.gl, source, () => this.sceneChanged());
  }

  sceneChanged() {
    const middle = this.sides?.left.scene.middle;
    if (middle && !this.touched && !this.camera.shape && middle !== this.framed) {
      this.framed = middle;
      this.camera.frame(middle, this.camera.up);
    }
    this.told();
    this.draw();
  }

  /**
   * @param {Side} left
   * @param {Side} right
   */
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

  /** Request a frame. */
  draw() {
    this.settled = false;
    this.canvas.dataset.state = "drawing";
    if (!this.requested && !this.ended) this.requested = requestAnimationFrame(() => this.step());
  }

  step() {
    this.requested = 0;
    if (this.lost || this.ended || this.headset) return;
    if (this.fence && !this.finished()) {
      this.requested = requestAnimationFrame(() => this.step());
      return;
    }
    const moving = performance.now() - this.movedAt < STILL;
    const scale = moving ? this.movingScale : 1;
    const again = this.askForOrder();
    this.scale = scale;
    this.render();
    this.begun = performance.now();
    this.fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
    this.frames++;
    this.settled = !again && scale === 1 && this.sides !== null;
    if (!this.sides) return;
    this.requested = requestAnimationFrame(() => (this.settled ? this.settle() : this.step()));
  }

  /** Wait until the last frame is finished, then stop. */
  settle() {
    this.requested = 0;
    if (this.lost || this.ended) return;
    if (!this.settled) return void (this.requested = requestAnimationFrame(() => this.step()));
    if (!this.finished()) {
      this.requested = requestAnimationFrame(() => this.settle());
      return;
    }
    const { left, right } = /** @type {{left: Side, right: Side}} */ (this.sides);
    this.canvas.dataset.state = left.scene.whole && right.scene.whole ? "settled" : "loading";
    this.told();
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
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    return [Math.max(1, Math.round(this.canvas.clientWidth * ratio)), Math.max(1, Math.round(this.canvas.clientHeight * ratio))];
  }

  render() {
    const { gl, canvas } = this, [width, height] = this.size();
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const w = Math.ceil(width * this.scale), h = Math.ceil(height * this.scale);
    this.target(w, h);
    gl.viewport(0, 0, w, h);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (this.sides) this.splats(this.sides, this.cut, [0, 0, w, h]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    this.composite(w / width);
    if (this.lines.length) this.drawLines(this.lines, width, height);
  }

  /**
   * Draw what the eyes see side by side.
   *
   * @param {{framebuffer: WebGLFramebuffer, framebufferWidth: number, framebufferHeight: number}} layer
   * @param {any[]} eyes cameras with their `viewport` [x, y, width, height]
   * @param {{left: Side, right: Side}} sides
   * @param {number} scale fraction of the layer's pixels in each direction
   * @param {Float32Array} lines pairs of points
   * @param {boolean} through whether the room is seen where the scene is transparent
   */
  renderEyes({ framebuffer, framebufferWidth, framebufferHeight }, eyes, sides, scale, lines, through) {
    const { gl } = this, own = this.camera, w = Math.ceil(framebufferWidth * scale), h = Math.ceil(framebufferHeight * scale);
    this.target(w, h);
    gl.disable(gl.SCISSOR_TEST);
    gl.viewport(0, 0, w, h);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    for (const eye of eyes) {
      this.camera = eye;
      const part = eye.viewport.map((/** @type {number} */ value) => Math.floor(value * scale));
      gl.viewport(part[0], part[1], part[2], part[3]);
      this.splats(sides, 1, part);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(0, 0, framebufferWidth, framebufferHeight);
    this.composite(w / framebufferWidth, through);
    for (const eye of lines.length ? eyes : []) {
      this.camera = eye;
      gl.viewport(eye.viewport[0], eye.viewport[1], eye.viewport[2], eye.viewport[3]);
      this.drawLines(lines, eye.viewport[2], eye.viewport[3]);
    }
    this.camera = own;
  }

  /**
   * Bind the framebuffer for blending, with a texture of this size. It has half precision if the browser supports that,
   * because 8 bits would lose faint Gaussians.
   *
   * @param {number} width
   * @param {number} height
   */
  target(width, height) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    if (this.pictureSize[0] === width && this.pictureSize[1] === height) return;
    gl.deleteTexture(this.picture);
    this.picture = gl.createTexture();
    this.pictureSize = [width, height];
    gl.bindTexture(gl.TEXTURE_2D, this.picture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.exact ? gl.RGBA16F : gl.RGBA8, width, height);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.LINEAR);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.picture, 0);
  }

  /**
   * @param {{left: Side, right: Side}} sides
   * @param {number} share fraction of the width that shows the left side
   * @param {number[]} viewport x, y, width and height in pixels
   */
  splats({ left, right }, share, [x, y, width, height]) {
    const { gl } = this, cut = Math.round(share * width);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (left.scene === right.scene) this.drawScene(left, right, x + cut, width, height);
    else {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(x, y, cut, height);
      if (cut > 0) this.drawScene(left, left, x + width, width, height);
      gl.scissor(x + cut, y, width - cut, height);
      if (cut < width) this.drawScene(right, right, x, width, height);
      gl.disable(gl.SCISSOR_TEST);
    }
    gl.disable(gl.BLEND);
  }

  /**
   * @param {Side} left
   * @param {Side} right colors of the same scene
   * @param {number} cut position of the wipe in pixels
   * @param {number} width
   * @param {number} height
   */
  drawScene(left, right, cut, width, height) {
    const { gl } = this, { scene } = left;
    const own = scene.colors.get("own");
    if (!scene.drawn || !own) return;
    const key = scene.degree * 100 + scene.bits;
    const { program, at } = this.splatPrograms.get(key) ?? this.program(splatVertex(scene.degree, scene.bits), splatFragment);
    this.splatPrograms.set(key, { program, at });
    gl.useProgram(program);
    this.setView(at, width, height);
    this.setMarks(at, scene);
    gl.uniform2f(at("fade"), 1 - (left.fade ?? 0), 1 - (right.fade ?? 0));
    gl.uniform1f(at("cut"), cut);
    const { antialiased, eps2d } = scene.header?.rendering ?? CLASSIC;
    gl.uniform1f(at("eps2d"), eps2d);
    gl.uniform1i(at("antialiased"), Number(antialiased));
    const textures = Object.entries({ geometry: scene.geometry, harmonics: scene.harmonics });
    for (const [name, side] of /** @type {[string, Side][]} */ ([["left", left], ["right", right]])) {
      const parts = side.blend ?? [{ colors: side.colors, weight: 1 }];
      gl.uniform3fv(at(`${name}Weights`), [0, 1, 2].map((i) => parts[i]?.weight ?? 0));
      [`${name}Colors`, `${name}1`, `${name}2`].forEach((sampler, i) => textures.push([sampler, scene.colors.get(parts[i]?.colors ?? "own") ?? own]));
    }
    textures.forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture ?? null);
      gl.uniform1i(at(name), unit);
    });
    gl.activeTexture(gl.TEXTURE0 + textures.length);
    this.drawInstances(scene);
  }

  /**
   * Set the Gaussians to highlight.
   *
   * @param {(name: string) => WebGLUniformLocation | null} at
   * @param {SplatScene} scene
   */
  setMarks(at, scene) {
    const { gl } = this;
    gl.uniform1f(at("highlight"), scene.marks ? HIGHLIGHT : 0);
    gl.activeTexture(gl.TEXTURE0 + MARKS_UNIT);
    gl.bindTexture(gl.TEXTURE_2D, scene.marks ?? scene.geometry ?? null);
    gl.uniform1i(at("marks"), MARKS_UNIT);
  }

  /** Draw each Gaussian of a scene's order as two triangles, with the current program. @param {SplatScene} scene */
  drawInstances(scene) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners ?? null);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, scene.order);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(1, 1);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, scene.drawn);
    gl.vertexAttribDivisor(1, 0);
    gl.disableVertexAttribArray(1);
  }

  /**
   * @param {(name: string) => WebGLUniformLocation | null} at
   * @param {number} width
   * @param {number} height
   */
  setView(at, width, height) {
    const { gl, camera } = this, [fx, fy] = camera.pixels(width, height), [sx, sy] = camera.shift(width, height);
    gl.uniform2f(at("shift"), sx, sy);
    gl.uniformMatrix3fv(at("axes"), false, camera.axes.flat());
    gl.uniform3f(at("eye"), camera.eye[0], camera.eye[1], camera.eye[2]);
    gl.uniform2f(at("focal"), fx, fy);
    gl.uniform2f(at("size"), width, height);
    gl.uniform1f(at("near"), camera.near);
  }

  /**
   * @param {number} scale
   * @param {boolean} through whether to keep transparency
   */
  composite(scale, through = false) {
    const { gl } = this, { program, at } = /** @type {Program} */ (this.compose);
    gl.useProgram(program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.picture);
    gl.uniform1i(at("picture"), 0);
    gl.uniform3f(at("background"), this.background[0], this.background[1], this.background[2]);
    gl.uniform2f(at("scale"), scale, scale);
    gl.uniform1f(at("solid"), Number(!through));
    gl.disableVertexAttribArray(0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /**
   * @param {Float32Array} lines pairs of points
   * @param {number} width
   * @param {number} height
   */
  drawLines(lines, width, height) {
    const { gl } = this, { program, at } = /** @type {Program} */ (this.line);
    gl.useProgram(program);
    this.setView(at, width, height);
    gl.uniform1f(at("near"), 1e-3 * this.camera.size);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer ?? null);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bufferData(gl.ARRAY_BUFFER, lines, gl.STREAM_DRAW);
    gl.uniform4fv(at("ink"), INK);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.LINES, 0, lines.length / 3);
    gl.disable(gl.BLEND);
  }

  /**
   * Return the current view as a PNG.
   *
   * @returns {Promise<Blob>}
   */
  picturePng() {
    this.scale = 1;
    this.render(); // a canvas drops its content when the task ends
    return new Promise((done, wrong) => this.canvas.toBlob((blob) => (blob ? done(blob) : wrong(new Error(words.viewer.noPicture))), "image/png"));
  }

  /**
   * Return the center of the Gaussian that is visible at or near a point of the canvas; null if there is none.
   *
   * @param {number} x CSS pixels
   * @param {number} y
   * @returns {Promise<number[] | null>}
   */
  async pointAt(x, y) {
    const view = new PickPass(this).draw(), { clientWidth, clientHeight } = this.canvas;
    const index = view ? gaussianAt(view, (x * view.width) / clientWidth, (y * view.height) / clientHeight) : -1;
    return index < 0 ? null : /** @type {Side} */ (this.sides?.left).scene.centerOf(index);
  }

  /** @param {Event} event */
  lose(event) {
    event.preventDefault();
    this.lost = true;
    this.canvas.dataset.state = "lost";
    this.told();
  }

  /** Reload everything after a lost GPU context is restored. */
  restore() {
    this.lost = false;
    this.prepare();
    this.framed = null;
    const before = this.sides;
    this.sides = null;
    if (before) this.onReload?.(before);
    this.told();
  }

  /** @type {((sides: {left: Side, right: Side}) => void) | undefined} */
  onReload;

  /** Free all resources. */
  end() {
    this.ended = true;
    cancelAnimationFrame(this.requested);
    this.resized.disconnect();
    this.canvas.removeEventListener("webglcontextlost", this.onLost);
    this.canvas.removeEventListener("webglcontextrestored", this.onRestored);
    for (const scene of new Set([this.sides?.left.scene, this.sides?.right.scene])) scene?.end();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}
