// @ts-check
/**
 * Image of the Gaussians that a view shows: each pixel holds one of them, drawn with its blend weight as probability.
 *
 * A fragment is kept with the probability of its alpha, and nearer ones are drawn over farther ones. The one that stays
 * is therefore Gaussian i with probability alpha_i times the product of (1 - alpha) of all nearer ones, its weight.
 */
import { splatVertex } from "./shaders.js";

/** Longer side of the image in pixels. */
const LONGER = 768;
/** Samplers of colors, and a unit without an integer texture for them, in case the driver retains unused ones. */
const COLORS = ["leftColors", "left1", "left2", "rightColors", "right1", "right2"], FREE_UNIT = 15;

const pickFragment = `#version 300 es
precision highp float; precision highp int;
in vec2 at;
flat in float opacity;
flat in uint who;
out uint found;
float random(uvec3 v) { // three rounds of a permuted congruential generator
  v = v * 1664525u + 1013904223u;
  v.x += v.y * v.z; v.y += v.z * v.x; v.z += v.x * v.y;
  v ^= v >> 16u;
  v.x += v.y * v.z; v.y += v.z * v.x; v.z += v.x * v.y;
  return float(v.x >> 8u) / 16777216.;
}
void main() {
  float alpha = min(opacity * exp(-0.5 * dot(at, at)), 0.99);
  if (alpha < 1. / 255. || alpha <= random(uvec3(gl_FragCoord.xy, who))) discard;
  found = who + 1u;
}`;

/**
 * Return the Gaussian at a pixel, or the nearest one within 8 pixels; -1 if there is none.
 *
 * @param {{ids: Uint32Array, width: number, height: number}} view
 * @param {number} x
 * @param {number} y
 */
export function gaussianAt({ ids, width, height }, x, y) {
  let found = -1, nearest = Infinity;
  for (let dy = -8; dy <= 8; dy++) {
    for (let dx = -8; dx <= 8; dx++) {
      const px = Math.floor(x) + dx, py = Math.floor(y) + dy, away = dx * dx + dy * dy;
      if (px < 0 || py < 0 || px >= width || py >= height || away >= nearest) continue;
      const id = ids[(height - 1 - py) * width + px];
      if (id) [found, nearest] = [id - 1, away];
    }
  }
  return found;
}

/** Draw the left side as the camera sees it; null without a scene. @param {import("./viewer.js").Viewer} viewer */
export function pickedView(viewer) {
  const { gl, camera, painter } = viewer, scene = viewer.sides?.left.scene;
  if (!scene?.drawn || !scene.geometry) return null;
  const [w, h] = viewer.size(), scale = Math.min(1, LONGER / Math.max(w, h));
  const width = Math.max(1, Math.round(w * scale)), height = Math.max(1, Math.round(h * scale));
  const target = gl.createTexture(), frame = gl.createFramebuffer();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, target);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, width, height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
  gl.viewport(0, 0, width, height);
  gl.disable(gl.BLEND);
  gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
  const at = painter.use(`picks ${scene.bits}`, () => [splatVertex(0, scene.bits), pickFragment]);
  painter.setScene(at, scene, width, height);
  gl.bindTexture(gl.TEXTURE_2D, scene.geometry);
  gl.uniform1i(at("geometry"), 0);
  for (const name of COLORS) gl.uniform1i(at(name), FREE_UNIT);
  painter.drawInstances(scene);
  const pixels = new Uint32Array(width * height * 4), ids = new Uint32Array(width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, pixels);
  for (let i = 0; i < ids.length; i++) ids[i] = pixels[4 * i];
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.deleteFramebuffer(frame);
  gl.deleteTexture(target);
  const { axes, eye, near } = camera;
  return { axes, eye, near, focal: camera.pixels(width, height), ids, width, height };
}
