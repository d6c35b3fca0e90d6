// @ts-check
/** Vectors of three numbers, and spherical harmonics of degree 1 to 3 in the order and with the signs of 3DGS files. */

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

/** Return the rows of the rotation of a unit quaternion. @param {number[]} quaternion xyzw */
export const turnOf = ([x, y, z, w]) => [
  [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
  [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
  [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
];

/** Polynomials of the view direction: coefficients of products such as "xxy". @type {Record<string, number>[]} */
const BASIS = [
  { y: -0.4886025119029199 }, { z: 0.4886025119029199 }, { x: -0.4886025119029199 },
  { xy: 1.0925484305920792 }, { yz: -1.0925484305920792 }, { zz: 0.6307831305050401, xx: -0.31539156525252005, yy: -0.31539156525252005 },
  { xz: -1.0925484305920792 }, { xx: 0.5462742152960396, yy: -0.5462742152960396 },
  { xxy: -1.7701307697799304, yyy: 0.5900435899266435 }, { xyz: 2.890611442640554 },
  { yzz: -1.8281831978578632, xxy: 0.4570457994644658, yyy: 0.4570457994644658 },
  { zzz: 0.7463526651802308, xxz: -1.1195289977703462, yyz: -1.1195289977703462 },
  { xzz: -1.8281831978578632, xxx: 0.4570457994644658, xyy: 0.4570457994644658 },
  { xxz: 1.445305721320277, yyz: -1.445305721320277 }, { xxx: -0.5900435899266435, xyy: 1.7701307697799304 },
];
/** Gauss-Legendre nodes and weights: with 8 angles about z, sums of products of two harmonics are their exact integrals. */
const NODES = [[0.3399810435848563, 0.6521451548625461], [-0.3399810435848563, 0.6521451548625461], [0.8611363115940526, 0.3478548451374538], [-0.8611363115940526, 0.3478548451374538]];

/** Expressions of the polynomials in GLSL, of x, y and z. */
export const EXPRESSIONS = BASIS.map((polynomial) => Object.entries(polynomial).map(([product, factor]) => `(${factor}) * ${[...product].join(" * ")}`).join(" + "));

/** Return the values of all polynomials at a unit vector. @param {Vector} d */
const valuesAt = (d) => BASIS.map((polynomial) => Object.entries(polynomial).reduce((sum, [product, factor]) => sum + [...product].reduce((value, axis) => value * d["xyz".indexOf(axis)], factor), 0));

/** Return how rotated coefficients follow: indices and factors of those before. @param {Vector[]} rows rotation */
export function rotatedHarmonics(rows) {
  const matrix = BASIS.map(() => BASIS.map(() => 0)), columns = [0, 1, 2].map((axis) => rows.map((row) => row[axis]));
  for (const [z, weight] of NODES) {
    for (let step = 0; step < 8; step++) {
      const flat = Math.sqrt(1 - z * z), angle = (step * Math.PI) / 4, d = [flat * Math.cos(angle), flat * Math.sin(angle), z];
      const after = valuesAt(d), before = valuesAt(columns.map((column) => dot(column, d)));
      matrix.forEach((row, i) => row.forEach((_, j) => (row[j] += ((weight * Math.PI) / 4) * after[i] * before[j])));
    }
  }
  return matrix.map((row) => row.flatMap((factor, j) => (Math.abs(factor) > 1e-9 ? [/** @type {[number, number]} */ ([j, factor])] : [])));
}
