// @ts-check
/** Pixels inside polygons of a view. */

/**
 * Return which pixels have their center inside a polygon, by the even-odd rule.
 *
 * @param {number[]} points x and y of each corner
 * @param {number} width
 * @param {number} height
 */
export function filled(points, width, height) {
  const found = new Uint8Array(width * height), corners = points.length / 2;
  for (let row = 0; row < height; row++) {
    const y = row + 0.5, crossings = [];
    for (let k = 0, last = corners - 1; k < corners; last = k++) {
      const y0 = points[2 * last + 1], y1 = points[2 * k + 1];
      if (y0 > y !== y1 > y) crossings.push(points[2 * last] + ((y - y0) / (y1 - y0)) * (points[2 * k] - points[2 * last]));
    }
    crossings.sort((a, b) => a - b);
    for (let k = 0; k + 1 < crossings.length; k += 2) {
      const from = Math.max(0, Math.ceil(crossings[k] - 0.5)), to = Math.min(width, Math.ceil(crossings[k + 1] - 0.5));
      if (to > from) found.fill(1, row * width + from, row * width + to);
    }
  }
  return found;
}
