// @ts-check
/**
 * Shaders: EWA splatting as in `sgsst render`, drawn once with two colors, each a blend of up to three color sets.
 *
 * Gaussians are blurred by 0.3 square pixels, or as their file states; if it is antialiased, their opacity is
 * compensated for that. Alpha is clamped between 1/255 and 0.99, and slopes are clamped at 1.3 times half the field of
 * view. The determinant is a sum of squares (Cauchy-Binet), so that thin Gaussians cause no cancellation.
 */
import { EXPRESSIONS } from "./vectors.js";
import { harmonicTexels, SCALE_LOW, SCALE_RANGE } from "./packing.js";

/** @param {number} degree */
function directional(degree) {
  const texels = harmonicTexels(degree), kept = (degree + 1) ** 2 - 1, lines = [];
  if (!degree) return "vec3 directional(int i, vec3 d) { return vec3(0); }";
  for (let t = 0; t < texels; t++) {
    lines.push(`uvec4 t${t} = texelFetch(harmonics, place(i * ${texels} + ${t}), 0);`);
    for (let c = 0; c < 4; c++) lines.push(`vec2 h${4 * t + c} = unpackHalf2x16(t${t}[${c}]);`);
  }
  const value = (/** @type {number} */ n) => `h${n >> 1}.${"xy"[n & 1]}`;
  const terms = EXPRESSIONS.slice(0, kept).map((product, k) => `(${product}) * vec3(${[0, 1, 2].map((c) => value(3 * k + c)).join(", ")})`);
  return `vec3 directional(int i, vec3 d) {
  float x = d.x, y = d.y, z = d.z;
  ${lines.join("\n  ")}
  return ${terms.join("\n    + ")};
}`;
}

/** @param {number} degree degree of spherical harmonics @param {number} bits base-2 logarithm of the texels of a row */
export const splatVertex = (degree, bits) => `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
layout(location = 0) in vec2 corner;
layout(location = 1) in uint index;
uniform usampler2D geometry, harmonics;
uniform sampler2D leftColors, left1, left2, rightColors, right1, right2;
uniform vec3 leftWeights, rightWeights;   // of three color sets each
uniform mat3 axes;          // columns: right, down, forward
uniform vec3 eye;
uniform vec2 focal, size, fade, shift;   // shift: principal point from the middle, pixels
uniform float near, eps2d;
uniform bool antialiased;
uniform usampler2D marks;   // 1 for Gaussians to highlight
uniform float highlight;    // 0 to highlight none
out vec3 leftColor, rightColor;
out vec2 at;
flat out float opacity, marked;
flat out uint who;
ivec2 place(int texel) { return ivec2(texel & ${(1 << bits) - 1}, texel >> ${bits}); }
vec2 fractions(uint both) { return max(vec2(ivec2(int(both << 16) >> 16, int(both) >> 16)) / 32767., -1.); }
${directional(degree)}
float deviation(uint stored) { return exp(${SCALE_LOW}. + float(stored) * ${SCALE_RANGE / 65535}); }
vec3 blended(sampler2D first, sampler2D second, sampler2D third, vec3 weights, ivec2 where) {
  vec3 sum = weights.x * texelFetch(first, where, 0).rgb;
  if (weights.y != 0.) sum += weights.y * texelFetch(second, where, 0).rgb;
  if (weights.z != 0.) sum += weights.z * texelFetch(third, where, 0).rgb;
  return sum;
}
void main() {
  gl_Position = vec4(2, 2, 2, 1);
  int i = int(index);
  who = index;
  marked = highlight > 0. ? highlight * float(texelFetch(marks, place(i), 0).r) : 0.;
  uvec4 g = texelFetch(geometry, place(2 * i), 0), h = texelFetch(geometry, place(2 * i + 1), 0);
  vec3 away = uintBitsToFloat(g.xyz) - eye, center = away * axes;
  opacity = float(g.w & 0xffffu) / 65535.;
  if (!(center.z >= near) || opacity * 255. < 1.) return;
  vec4 q = normalize(vec4(fractions(h.x), fractions(h.y)));
  vec3 s = vec3(deviation(g.w >> 16), deviation(h.z & 0xffffu), deviation(h.z >> 16));
  mat3 turned = mat3(
    1. - 2. * (q.z * q.z + q.w * q.w), 2. * (q.y * q.z + q.x * q.w), 2. * (q.y * q.w - q.x * q.z),
    2. * (q.y * q.z - q.x * q.w), 1. - 2. * (q.y * q.y + q.w * q.w), 2. * (q.z * q.w + q.x * q.y),
    2. * (q.y * q.w + q.x * q.z), 2. * (q.z * q.w - q.x * q.y), 1. - 2. * (q.y * q.y + q.z * q.z));
  vec3 along = (axes[0] * turned) * s, across = (axes[1] * turned) * s, ahead = (axes[2] * turned) * s;
  vec2 most = 0.65 * size / focal, slope = clamp(center.xy / center.z, -most, most);
  vec3 m = focal.x / center.z * (along - slope.x * ahead), n = focal.y / center.z * (across - slope.y * ahead);
  float A = dot(m, m) + eps2d, B = dot(m, n), C = dot(n, n) + eps2d;
  vec3 minors = cross(m, n);
  float unblurred = dot(minors, minors), determinant = unblurred + eps2d * (A + C - eps2d);
  if (antialiased) opacity *= sqrt(unblurred / determinant);
  if (!(opacity * 255. >= 1.)) return;
  float longer = 0.5 * (A + C) + sqrt(0.25 * (A - C) * (A - C) + B * B), shorter = determinant / longer;
  vec2 d = A >= C ? vec2(longer - C, B) : vec2(B, longer - A);
  d = dot(d, d) > 1e-20 ? normalize(d) : vec2(1, 0);
  float reach = sqrt(2. * log(255. * opacity));   // to where alpha is 1/255
  vec2 offset = reach * (corner.x * sqrt(longer) * d + corner.y * sqrt(shorter) * vec2(-d.y, d.x));
  vec2 pixel = focal * center.xy / center.z + shift + offset;
  gl_Position = vec4(2. * pixel.x / size.x, -2. * pixel.y / size.y, 0, 1);
  at = corner * reach;
  vec3 rest = directional(i, normalize(away));
  ivec2 where = place(i);
  leftColor = max(0.5 + fade.x * rest + 0.28209479177387814 * blended(leftColors, left1, left2, leftWeights, where), 0.);
  rightColor = max(0.5 + fade.y * rest + 0.28209479177387814 * blended(rightColors, right1, right2, rightWeights, where), 0.);
}`;

export const splatFragment = `#version 300 es
precision highp float;
in vec3 leftColor, rightColor;
in vec2 at;
flat in float opacity, marked;
uniform float cut;          // pixels; what is left of it has the left colors
out vec4 color;
void main() {
  float alpha = min(opacity * exp(-0.5 * dot(at, at)), 0.99);
  if (alpha < 1. / 255.) discard;
  color = vec4(mix(gl_FragCoord.x < cut ? leftColor : rightColor, vec3(0.1, 0.9, 1), marked) * alpha, alpha);
}`;

/** Triangle that covers the whole canvas. */
export const wholeVertex = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3. : -1., gl_VertexID == 2 ? 3. : -1., 0, 1); }`;

export const overBackground = `#version 300 es
precision highp float;
uniform highp sampler2D picture;
uniform vec3 background;
uniform vec2 scale;         // texels of the picture for a pixel
uniform float solid;        // 0 to keep transparency
out vec4 color;
void main() {
  vec4 found = scale.x == 1. ? texelFetch(picture, ivec2(gl_FragCoord.xy), 0)
    : texture(picture, gl_FragCoord.xy * scale / vec2(textureSize(picture, 0)));
  color = vec4(found.rgb + solid * (1. - found.a) * background, max(found.a, solid));
}`;

export const lineVertex = `#version 300 es
precision highp float;
layout(location = 0) in vec3 point;
uniform mat3 axes;
uniform vec3 eye;
uniform vec2 focal, size, shift;
uniform float near;
void main() {
  vec3 c = (point - eye) * axes;
  vec2 pixel = focal * c.xy + shift * c.z;
  gl_Position = vec4(2. * pixel.x / size.x, -2. * pixel.y / size.y, c.z - near, c.z);
}`;

export const lineFragment = `#version 300 es
precision highp float;
uniform vec4 ink;
out vec4 color;
void main() { color = ink; }`;
