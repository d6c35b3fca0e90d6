// @ts-check
/**
 * Conversion of floats to half precision (IEEE 754 binary16), rounded to nearest and clamped to the largest finite
 * value, and back.
 */

const BASE = new Uint16Array(512), SHIFT = new Uint8Array(512), HIDDEN = new Uint32Array(512), ROUND = new Uint32Array(512);

for (let key = 0; key < 512; key++) {
  const sign = key & 256 ? 0x8000 : 0, exponent = (key & 255) - 127;
  BASE[key] = sign;
  SHIFT[key] = 31;
  if (exponent > 15) BASE[key] = sign | 0x7bff;
  else if (exponent >= -14) {
    BASE[key] = sign | ((exponent + 15) << 10);
    SHIFT[key] = 13;
    ROUND[key] = 0x1000;
  } else if (exponent >= -25) { // a subnormal half counts in units of 2^-24
    SHIFT[key] = -exponent - 1;
    HIDDEN[key] = 0x800000;
    ROUND[key] = 1 << (-exponent - 2);
  }
}

/** @param {number} bits bits of a float32 @returns {number} bits of a half */
export function halfOf(bits) {
  const key = bits >>> 23;
  const half = BASE[key] + ((((bits & 0x7fffff) | HIDDEN[key]) + ROUND[key]) >>> SHIFT[key]);
  return (half & 0x7fff) === 0x7c00 ? half - 1 : half;
}

/** @param {number} half bits of a half */
export function fromHalf(half) {
  const sign = half & 0x8000 ? -1 : 1, exponent = (half >> 10) & 31, fraction = half & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
}
