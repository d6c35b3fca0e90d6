// @ts-check
/** Drawing of a viewer's scenes with WebGL 2: the Gaussians on both sides of the wipe, then lines over them. */
import { CLASSIC } from "./render_tag.js";
import { lineFragment, lineVertex, overBackground, splatFragment, splatVertex, wholeVertex } from "./shaders.js";

/** @typedef {import("./viewer.js").Side} Side */
/** @typedef {import("./splat_scene.js").SplatScene} SplatScene */
/** @typedef {(name: string) => WebGLUniformLocation | null} Locate returns where a uniform of a program is */
/** @typedef {{program: WebGLProgram, at: Locate}} Program */

/** Fraction of the highlight's color in highlighted Gaussians. */
const HIGHLIGHT = 0.6;
/** Color of lines, and their opacity. */
const INK = [0.98, 0.6, 0.28, 0.55];

export class Painter {
  /** @param {import("./viewer.js").Viewer} viewer */
  constructor(viewer) {
    const gl = (this.gl = viewer.gl);
    this.viewer = viewer;
    this.exact = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    gl.getExtension("OES_texture_float_linear");
    /** @type {Map<string, Program>} */
    this.programs = new Map();
    this.corners = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    this.lineBuffer = gl.createBuffer();
    /** Framebuffer for blending. */
    this.frame = gl.createFramebuffer();
    /** @type {WebGLTexture | null} */
    this.picture = null;
    this.pictureSize = [0, 0];
  }

  /** Use a program; return how to find uniforms. @param {string} name @param {() => [string, string]} shaders texts */
  use(name, shaders) {
    const { program, at } = this.programs.get(name) ?? this.program(...shaders());
    this.programs.set(name, { program, at });
    this.gl.useProgram(program);
    return at;
  }

  /** @param {string} vertex @param {string} fragment @returns {Program} */
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

  render() {
    const { gl, viewer: { canvas } } = this, [width, height] = this.viewer.size();
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const w = Math.ceil(width * this.viewer.scale), h = Math.ceil(height * this.viewer.scale);
    this.target(w, h);
    if (this.viewer.sides) this.splats(this.viewer.sides, this.viewer.cut, [0, 0, w, h]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    this.composite(w / width);
    if (this.viewer.lines.length) this.drawLines(this.viewer.lines, width, height);
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
    const { gl } = this, own = this.viewer.camera, w = Math.ceil(framebufferWidth * scale), h = Math.ceil(framebufferHeight * scale);
    this.target(w, h);
    for (const eye of eyes) {
      this.viewer.camera = eye;
      const part = eye.viewport.map((/** @type {number} */ value) => Math.floor(value * scale));
      gl.viewport(part[0], part[1], part[2], part[3]);
      this.splats(sides, 1, part);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(0, 0, framebufferWidth, framebufferHeight);
    this.composite(w / framebufferWidth, through);
    for (const eye of lines.length ? eyes : []) {
      this.viewer.camera = eye;
      gl.viewport(eye.viewport[0], eye.viewport[1], eye.viewport[2], eye.viewport[3]);
      this.drawLines(lines, eye.viewport[2], eye.viewport[3]);
    }
    this.viewer.camera = own;
  }

  /**
   * Bind and clear the framebuffer for blending, with a texture of this size. It has half precision if the browser
   * supports that, because 8 bits would lose faint Gaussians.
   *
   * @param {number} width
   * @param {number} height
   */
  target(width, height) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    if (this.pictureSize[0] !== width || this.pictureSize[1] !== height) {
      gl.deleteTexture(this.picture);
      this.picture = gl.createTexture();
      this.pictureSize = [width, height];
      gl.bindTexture(gl.TEXTURE_2D, this.picture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, this.exact ? gl.RGBA16F : gl.RGBA8, width, height);
      for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
      for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.LINEAR);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.picture, 0);
    }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  /** @param {{left: Side, right: Side}} sides @param {number} share see `Viewer.cut` @param {number[]} viewport */
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

  /** @param {Side} left @param {Side} right @param {number} cut pixels @param {number} width @param {number} height */
  drawScene(left, right, cut, width, height) {
    const { gl } = this, { scene } = left;
    const own = scene.colors.get("own");
    if (!scene.drawn || !own) return;
    const at = this.use(`splats ${scene.degree} ${scene.bits}`, () => [splatVertex(scene.degree, scene.bits), splatFragment]);
    this.setScene(at, scene, width, height);
    gl.uniform2f(at("fade"), 1 - (left.fade ?? 0), 1 - (right.fade ?? 0));
    gl.uniform1f(at("cut"), cut);
    gl.uniform1f(at("highlight"), scene.marks ? HIGHLIGHT : 0);
    const textures = Object.entries({ geometry: scene.geometry, harmonics: scene.harmonics, marks: scene.marks ?? scene.geometry });
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

  /** Draw each Gaussian of a scene's order as two triangles, with the current program. @param {SplatScene} scene */
  drawInstances(scene) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
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

  /** @param {Locate} at @param {SplatScene} scene @param {number} width @param {number} height */
  setScene(at, scene, width, height) {
    const { antialiased, eps2d } = scene.header?.rendering ?? CLASSIC;
    this.setView(at, width, height);
    this.gl.uniform1f(at("eps2d"), eps2d);
    this.gl.uniform1i(at("antialiased"), Number(antialiased));
  }

  /** @param {Locate} at @param {number} width @param {number} height */
  setView(at, width, height) {
    const { gl, viewer: { camera } } = this, [fx, fy] = camera.pixels(width, height), [sx, sy] = camera.shift(width, height);
    gl.uniform2f(at("shift"), sx, sy);
    gl.uniformMatrix3fv(at("axes"), false, camera.axes.flat());
    gl.uniform3f(at("eye"), camera.eye[0], camera.eye[1], camera.eye[2]);
    gl.uniform2f(at("focal"), fx, fy);
    gl.uniform2f(at("size"), width, height);
    gl.uniform1f(at("near"), camera.near);
  }

  /** @param {number} scale @param {boolean} through whether to keep transparency */
  composite(scale, through = false) {
    const { gl } = this, at = this.use("whole", () => [wholeVertex, overBackground]);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.picture);
    gl.uniform1i(at("picture"), 0);
    gl.uniform3f(at("background"), this.viewer.background[0], this.viewer.background[1], this.viewer.background[2]);
    gl.uniform2f(at("scale"), scale, scale);
    gl.uniform1f(at("solid"), Number(!through));
    gl.disableVertexAttribArray(0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** @param {Float32Array} lines pairs of points @param {number} width @param {number} height */
  drawLines(lines, width, height) {
    const { gl } = this, at = this.use("lines", () => [lineVertex, lineFragment]);
    this.setView(at, width, height);
    gl.uniform1f(at("near"), 1e-3 * this.viewer.camera.size);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bufferData(gl.ARRAY_BUFFER, lines, gl.STREAM_DRAW);
    gl.uniform4fv(at("ink"), INK);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.LINES, 0, lines.length / 3);
    gl.disable(gl.BLEND);
  }
}
