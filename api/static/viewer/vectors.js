// @ts-check
/** Vectors of three numbers. */

/** @typedef {number[]} Vector */

/** @param {Vector} a @param {Vector} b */
export const sum = (a, b) => a.map((value, i) => value + b[i]);
/** @param {Vector} a @param {Vector} b */
export const difference = (a, b) => a.map((value, i) => value - b[i]);
/** @param {Vector} a @param {number} factor */
export const times = (a, factor) => a.map((value) => value * factor);
/** @param {Vector} a @param {Vector} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @param {Vector} a @param {Vector} b */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** @param {Vector} a */
export const unit = (a) => times(a, 1 / (Math.hypot(...a) || 1));

/** @param {Vector} a @param {Vector} axis unit vector @param {number} angle radians */
export function rotated(a, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), across = cross(axis, a), along = dot(axis, a) * (1 - c);
  return a.map((value, i) => value * c + across[i] * s + axis[i] * along);
}
