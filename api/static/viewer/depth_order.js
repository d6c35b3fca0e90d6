// @ts-check
/** Which Gaussians a view may show, the farthest first. */

/**
 * @typedef {{axes: number[][], eye: number[], tan: number[], near: number}} Pose
 *   `axes`: right, down and forward, unit vectors in the world; `tan`: of half the field of view across and down
 */

const DIGIT = 11, BUCKETS = 1 << DIGIT, MOST = 2 * DIGIT;
/** How much wider than the view what is kept is: it is drawn while a new order is computed, too. */
const WIDER = 1.3;

/**
 * Sorted by the bits of their float32 depth, which order as positive floats do; the spread of depths is cut to 22 bits (a
 * millionth of the depth), which two passes of counting sort. Equal depths are in the order of the file, which is nearest
 * first, as in `sgsst render`.
 *
 * @param {Float32Array} centers [n * 3]
 * @param {Float32Array} reach [n], see `Packed`; negative for what shows nowhere
 * @param {number} count of Gaussians, at most n
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
    const room = far + 0.02 * depth; // a dilated Gaussian covers a pixel and more, however far it is
    if (Math.abs(rx * x + ry * y + rz * z) > across * depth + slantX * room) continue;
    if (Math.abs(dx * x + dy * y + dz * z) > down * depth + slantY * room) continue;
    found[visible] = i;
    depths[visible++] = depth;
  }
  return sorted(found, new Uint32Array(depths.buffer), visible);
}

/**
 * @param {Uint32Array} found
 * @param {Uint32Array} bits of their depths
 * @param {number} count
 */
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
    const key = (bits[i] = (high - bits[i]) >>> shift); // the farthest first
    first[(key & (BUCKETS - 1)) + 1]++;
    second[(key >>> DIGIT) + 1]++;
  }
  for (let b = 0; b < BUCKETS; b++) {
    first[b + 1] += first[b];
    second[b + 1] += second[b];
  }
  const between = new Uint32Array(count), order = new Uint32Array(count);
  for (let i = count - 1; i >= 0; i--) between[first[bits[i] & (BUCKETS - 1)]++] = i; // of equal ones the last first
  for (let i = 0; i < count; i++) order[second[bits[between[i]] >>> DIGIT]++] = found[between[i]];
  return order;
}
