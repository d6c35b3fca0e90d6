// @ts-check
/** Gaussians that may be visible in a view, sorted from the farthest to the nearest. */

/**
 * @typedef {{axes: number[][], eye: number[], tan: number[], near: number}} Pose
 *   `axes`: right, down and forward, unit vectors in the world; `tan`: of half the field of view across and down
 */

const DIGIT = 11, BUCKETS = 1 << DIGIT, MOST = 2 * DIGIT;
/** Factor by which the culling frustum is wider than the view: the order is also drawn while a new one is computed. */
const WIDER = 1.3;

/**
 * Return the indices of the Gaussians that may be visible, farthest first.
 *
 * The sort keys are the bits of the float32 depths, which order as positive floats do. Their range is reduced to 22
 * bits (a millionth of the depth), which two passes of counting sort cover. Of equal depths, the first one in the file
 * counts as nearest, as in `sgsst render`.
 *
 * @param {Float32Array} centers [n * 3]
 * @param {Float32Array} reach [n], see `Packed`; negative for Gaussians that are never visible
 * @param {number} count number of Gaussians, at most n
 * @param {Pose} pose
 * @returns {Uint32Array}
 */
export function depthOrder(centers, reach, count, { axes, eye, tan, near }) {
  const [[rx, ry, rz], [dx, dy, dz], [fx, fy, fz]] = axes, [ex, ey, ez] = eye;
  const across = tan[0] * WIDER, down = tan[1] * WIDER;
  const slantX = Math.hypot(1, across), slantY = Math.hypot(1, down);
  const found = new Uint32Array(count), depths = new Float32Array(count);
  let visible = 0;
  for (let i = 0; i < count; i++) {
    const far = reach[i];
    if (far < 0) continue;
    const x = centers[3 * i] - ex, y = centers[3 * i + 1] - ey, z = centers[3 * i + 2] - ez;
    const depth = fx * x + fy * y + fz * z;
    if (depth < near) continue;
    const room = far + 0.02 * depth; // a dilated Gaussian covers at least a pixel at any distance
    if (Math.abs(rx * x + ry * y + rz * z) > across * depth + slantX * room) continue;
    if (Math.abs(dx * x + dy * y + dz * z) > down * depth + slantY * room) continue;
    found[visible] = i;
    depths[visible++] = depth;
  }
  return sorted(found, new Uint32Array(depths.buffer), visible);
}

/** @param {Uint32Array} found @param {Uint32Array} bits bits of their depths @param {number} count */
function sorted(found, bits, count) {
  let low = 0xffffffff, high = 0;
  for (let i = 0; i < count; i++) {
    if (bits[i] < low) low = bits[i];
    if (bits[i] > high) high = bits[i];
  }
  let shift = 0;
  while (count && (high - low) / 2 ** shift >= 1 << MOST) shift++;
  const first = new Uint32Array(BUCKETS + 1), second = new Uint32Array(BUCKETS + 1);
  for (let i = 0; i < count; i++) {
    const key = (bits[i] = (high - bits[i]) >>> shift); // farthest first
    first[(key & (BUCKETS - 1)) + 1]++;
    second[(key >>> DIGIT) + 1]++;
  }
  for (let b = 0; b < BUCKETS; b++) {
    first[b + 1] += first[b];
    second[b + 1] += second[b];
  }
  const between = new Uint32Array(count), order = new Uint32Array(count);
  for (let i = count - 1; i >= 0; i--) between[first[bits[i] & (BUCKETS - 1)]++] = i; // of equal depths, the last one first
  for (let i = 0; i < count; i++) order[second[bits[between[i]] >>> DIGIT]++] = found[between[i]];
  return order;
}
