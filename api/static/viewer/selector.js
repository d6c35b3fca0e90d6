// @ts-check
/**
 * Selection of Gaussians in the worker that holds a scene's centers and colors.
 *
 * Each change is stored as the list of Gaussians whose flag flips, so undoing flips them back. Positions in the view are
 * computed once per view. A Gaussian is visible in a view unless it is behind what the view shows where its center is;
 * this depth comes from an image of visible Gaussians (`pickedView`).
 */
import { SH_C0 } from "./packing.js";
import { gaussianAt } from "./pick_pass.js";

/** @typedef {{axes: number[][], eye: number[], focal: number[], near: number, ids: Uint32Array, width: number, height: number}} PickedView `ids`: one more than the index of the Gaussian that a pixel shows, or 0; rows from bottom to top */
/** @typedef {"add" | "subtract" | "intersect"} Mode `intersect` deselects what does not pass */

/** Side of the squares of pixels that share a depth. */
const SQUARE = 4;
/** Quantile of the depths in a square that counts as its depth, and fraction of a Gaussian's reach that is added: two standard deviations. */
const SURFACE = 0.75, THICKNESS = 0.6;
/** Maximum number of stored flips of all changes that can be undone. */
const MOST_FLIPS = 5e7;

/** Return colors as bytes. @param {Float32Array} rows @param {number} width @param {Record<string, number>} at */
export function rgbOf(rows, width, at) {
  const count = rows.length / width, found = new Uint8ClampedArray(count * 3), places = [at.f_dc_0, at.f_dc_1, at.f_dc_2];
  for (let i = 0; i < count; i++) for (let c = 0; c < 3; c++) found[3 * i + c] = 255 * (0.5 + SH_C0 * rows[i * width + places[c]]);
  return found;
}

export class Selector {
  /**
   * @param {Float32Array} centers [n * 3]
   * @param {Float32Array} reach [n], see `Packed`
   * @param {Uint8ClampedArray} colors [n * 3]
   * @param {number} radius radius of the bulk of the scene
   */
  constructor(centers, reach, colors, radius) {
    this.centers = centers;
    this.reach = reach;
    this.colors = colors;
    this.radius = radius;
    this.count = reach.length;
    this.flags = new Uint8Array(this.count);
    this.total = 0;
    /** @type {Uint32Array[]} */
    this.past = [];
    /** @type {Uint32Array[]} */
    this.future = [];
    /** @type {CellGrid | undefined} */
    this.grid = undefined;
    /** Number of the last change, if later parts may follow. @type {number | undefined} */
    this.last = undefined;
    /** Position of each center in the view, in pixels; NaN if it is behind the camera. */
    this.x = new Float32Array(0);
    this.y = new Float32Array(0);
    this.visible = new Uint8Array(0);
    this.width = this.height = 0;
    this.ids = new Uint32Array(0);
  }

  /** Apply a change, and return what the page shows. @param {any} request `op`: a method below that takes a request */
  answer(request) {
    const flips = request.op === "bits" ? [] : request.op === "view" ? this.setView(request) : this.change(request);
    const counts = { total: this.total, past: this.past.length, future: this.future.length };
    return { ...this.range(flips), ...counts, ...(request.op === "bits" ? { bits: this.bits() } : {}) };
  }

  /** Change flags, and return lists of flips. @param {any} request `replaces`: undo the last change first */
  change(request) {
    if (request.op === "undo") return [this.move(this.past, this.future)];
    if (request.op === "redo") return [this.move(this.future, this.past)];
    const undone = request.replaces ? this.move(this.past, []) : new Uint32Array(0);
    const found = /** @type {Record<string, (request: any) => ArrayLike<number>>} */ ({
      stroke: (each) => this.stroke(each), lasso: (each) => this.lasso(each), box: (each) => this.box(each), sphere: (each) => this.sphere(each),
      similar: (each) => this.similar(each), invert: () => this.all(() => true), clear: () => this.all((/** @type {number} */ i) => this.flags[i] === 1), load: (each) => this.load(each),
    })[request.op](request);
    const flips = Uint32Array.from(found);
    this.flip(flips);
    this.remember(flips, request);
    return [undone, flips];
  }

  /** @param {ArrayLike<number>} flips */
  flip(flips) {
    for (let k = 0; k < flips.length; k++) this.total += (this.flags[flips[k]] ^= 1) ? 1 : -1;
  }

  /**
   * Store a change, so that it can be undone.
   *
   * @param {Uint32Array} flips
   * @param {{op: string, change?: number}} request `change`: number of the change; later parts of a stroke have the same
   */
  remember(flips, { op, change }) {
    if (op === "load") [this.past, this.future] = [[], []];
    if (op === "load" || !flips.length) return;
    this.future = [];
    if (change !== undefined && change === this.last) this.past.push(joined(/** @type {Uint32Array} */ (this.past.pop()), flips));
    else this.past.push(flips);
    this.last = change;
    for (let held = this.past.reduce((sum, each) => sum + each.length, 0); held > MOST_FLIPS && this.past.length > 1; ) held -= /** @type {Uint32Array} */ (this.past.shift()).length;
  }

  /** Flip the last change of a list, and move it to another. @param {Uint32Array[]} from @param {Uint32Array[]} to */
  move(from, to) {
    const flips = from.pop();
    this.last = undefined;
    if (!flips) return new Uint32Array(0);
    this.flip(flips);
    to.push(flips);
    return flips;
  }

  /** Return the flags from the first to the last flip. @param {Uint32Array[]} lists */
  range(lists) {
    let first = this.count, last = -1;
    for (const flips of lists) {
      for (let k = 0; k < flips.length; k++) {
        if (flips[k] < first) first = flips[k];
        if (flips[k] > last) last = flips[k];
      }
    }
    return { begin: Math.min(first, last + 1), flags: this.flags.slice(first, last + 1) };
  }

  /** Return the flags as packed bits, the lowest bit first. */
  bits() {
    const packed = new Uint8Array(Math.ceil(this.count / 8));
    for (let i = 0; i < this.count; i++) packed[i >> 3] |= this.flags[i] << (i & 7);
    return packed;
  }

  /** @param {{bits: Uint8Array}} request @returns {ArrayLike<number>} */
  load({ bits }) {
    return this.all((i) => ((bits[i >> 3] >> (i & 7)) & 1) !== this.flags[i]);
  }

  /** Return the Gaussians that pass a test. @param {(i: number) => boolean} passes */
  all(passes) {
    const found = new Uint32Array(this.count);
    let n = 0;
    for (let i = 0; i < this.count; i++) if (passes(i)) found[n++] = i;
    return found.subarray(0, n);
  }

  /** Return the Gaussians that pass a test and whose flag a mode changes. @param {Mode} mode @param {(i: number) => boolean} passes */
  changing(mode, passes) {
    const before = mode === "add" ? 0 : 1, wanted = mode !== "intersect", { flags } = this;
    return this.all((i) => flags[i] === before && passes(i) === wanted);
  }

  /** Compute where the view shows the Gaussians, and which of them are visible. @param {PickedView} view @returns {Uint32Array[]} */
  setView(view) {
    const { axes: [right, down, forward], eye, focal, near, width, height } = view, { centers, reach, count } = this;
    Object.assign(this, { ids: view.ids, width, height, x: new Float32Array(count), y: new Float32Array(count), visible: new Uint8Array(count) });
    const depthOf = (/** @type {number} */ i) => forward[0] * (centers[3 * i] - eye[0]) + forward[1] * (centers[3 * i + 1] - eye[1]) + forward[2] * (centers[3 * i + 2] - eye[2]);
    const depths = this.surface(depthOf), across = Math.ceil(width / SQUARE);
    for (let i = 0; i < count; i++) {
      const X = centers[3 * i] - eye[0], Y = centers[3 * i + 1] - eye[1], Z = centers[3 * i + 2] - eye[2], depth = forward[0] * X + forward[1] * Y + forward[2] * Z;
      if (reach[i] < 0 || !(depth >= near)) {
        this.x[i] = NaN;
        continue;
      }
      const x = (this.x[i] = width / 2 + (focal[0] * (right[0] * X + right[1] * Y + right[2] * Z)) / depth);
      const y = (this.y[i] = height / 2 + (focal[1] * (down[0] * X + down[1] * Y + down[2] * Z)) / depth);
      const inside = x >= 0 && y >= 0 && x < width && y < height;
      this.visible[i] = Number(inside && depth <= depths[Math.floor(y / SQUARE) * across + Math.floor(x / SQUARE)]);
    }
    return [];
  }

  /** Return the greatest depth of visible Gaussians in each square of the view. @param {(i: number) => number} depthOf */
  surface(depthOf) {
    const { ids, width, height, reach } = this, across = Math.ceil(width / SQUARE), down = Math.ceil(height / SQUARE);
    const found = new Float32Array(across * down).fill(Infinity), depths = new Float32Array(SQUARE * SQUARE);
    for (let square = 0; square < found.length; square++) {
      const left = (square % across) * SQUARE, top = Math.floor(square / across) * SQUARE;
      let n = 0;
      for (let y = top; y < Math.min(top + SQUARE, height); y++) {
        for (let x = left; x < Math.min(left + SQUARE, width); x++) {
          const id = ids[(height - 1 - y) * width + x];
          if (id) depths[n++] = depthOf(id - 1) + THICKNESS * reach[id - 1];
        }
      }
      if (n) found[square] = depths.subarray(0, n).sort()[Math.floor(SURFACE * (n - 1))];
    }
    return found;
  }

  /** @param {{points: number[], radius: number, mode: Mode, through: boolean}} request `points`: x and y of each */
  stroke({ points, radius, mode, through }) {
    const { x, y, visible } = this, xs = points.filter((_, k) => !(k & 1)), ys = points.filter((_, k) => k & 1);
    const left = Math.min(...xs) - radius, right = Math.max(...xs) + radius, top = Math.min(...ys) - radius, bottom = Math.max(...ys) + radius;
    const near = (/** @type {number} */ px, /** @type {number} */ py) => {
      for (let k = 0; k < xs.length; k++) {
        const next = Math.min(k + 1, xs.length - 1), dx = xs[next] - xs[k], dy = ys[next] - ys[k];
        const along = Math.max(0, Math.min(1, ((px - xs[k]) * dx + (py - ys[k]) * dy) / (dx * dx + dy * dy || 1)));
        if ((px - xs[k] - along * dx) ** 2 + (py - ys[k] - along * dy) ** 2 <= radius * radius) return true;
      }
      return false;
    };
    return this.changing(mode, (i) => x[i] >= left && x[i] <= right && y[i] >= top && y[i] <= bottom && (through || visible[i] === 1) && near(x[i], y[i]));
  }

  /** Return those inside a polygon. @param {{points: number[], mode: Mode, through: boolean}} request */
  lasso({ points, mode, through }) {
    const { x, y, visible, width, height } = this, inside = filled(points, width, height);
    return this.changing(mode, (i) => x[i] >= 0 && y[i] >= 0 && x[i] < width && y[i] < height && (through || visible[i] === 1) && inside[Math.floor(y[i]) * width + Math.floor(x[i])] === 1);
  }

  /** @param {{low: number[], high: number[], mode: Mode}} request */
  box({ low, high, mode }) {
    const { centers } = this;
    return this.changing(mode, (i) => [0, 1, 2].every((axis) => centers[3 * i + axis] >= low[axis] && centers[3 * i + axis] <= high[axis]));
  }

  /** @param {{center: number[], radius: number, mode: Mode}} request */
  sphere({ center, radius, mode }) {
    const { centers } = this;
    return this.changing(mode, (i) => (centers[3 * i] - center[0]) ** 2 + (centers[3 * i + 1] - center[1]) ** 2 + (centers[3 * i + 2] - center[2]) ** 2 <= radius * radius);
  }

  /** @param {{point: number[], tolerance: number, connected: boolean, mode: Mode}} request `tolerance`: 0 to 1 */
  similar({ point, tolerance, connected, mode }) {
    const seed = gaussianAt(this, point[0], point[1]), { colors } = this;
    if (seed < 0) return [];
    const [r, g, b] = colors.subarray(3 * seed, 3 * seed + 3), most = 3 * (255 * tolerance) ** 2;
    const alike = (/** @type {number} */ i) => (colors[3 * i] - r) ** 2 + (colors[3 * i + 1] - g) ** 2 + (colors[3 * i + 2] - b) ** 2 <= most;
    if (!connected) return this.changing(mode, alike);
    const reached = new Uint8Array(this.count);
    this.grid ??= new CellGrid(this.centers, this.count, this.radius);
    for (const i of this.grid.flood(seed, alike)) reached[i] = 1;
    return this.changing(mode, (i) => reached[i] === 1);
  }
}

/** @param {Uint32Array} first @param {Uint32Array} second */
function joined(first, second) {
  const both = new Uint32Array(first.length + second.length);
  both.set(first);
  both.set(second, first.length);
  return both;
}

/** Fill a polygon (even-odd). @param {number[]} points x, y, x, ... @param {number} width @param {number} height */
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

/** Bits of a cell's position along an axis, in the keys of cells. */
const KEY_SIDE = 2 ** 16;
/** Wanted mean number of Gaussians in an occupied cell. */
const FEWEST = 3, MOST = 24;
/** Steps along an axis to a cell and its neighbors. */
const STEPS = [-1, 0, 1];
/** Steps to a cell and the 26 around it, as differences of keys. */
const AROUND = STEPS.flatMap((z) => STEPS.flatMap((y) => STEPS.map((x) => x + KEY_SIDE * (y + KEY_SIDE * z))));

/** Grid of cells over the centers of a scene's Gaussians, for searches among neighbors. */
class CellGrid {
  /** @param {Float32Array} centers [n * 3] @param {number} count @param {number} radius that of the scene's bulk */
  constructor(centers, count, radius) {
    this.centers = centers;
    this.count = count;
    /** Side of a cell, which is about twice the distance between neighbors on a surface. */
    this.side = Math.max((7 * radius) / Math.sqrt(Math.max(count, 1)), 1e-9);
    this.cellOf = new Uint32Array(count);
    /** Numbers of cells by key. @type {Map<number, number>} */
    this.cells = new Map();
    /** @type {number[]} */
    this.keys = [];
    /** Gaussians, cell by cell: those of a cell are `items[starts[cell]]` up to before `items[starts[cell + 1]]`. */
    this.items = new Uint32Array(count);
    this.starts = new Uint32Array(0);
    for (let attempt = 0; attempt < 6; attempt++) {
      this.assign();
      const mean = count / Math.max(this.keys.length, 1);
      if (mean >= FEWEST && mean <= MOST) break;
      this.side *= mean < FEWEST ? 1.5 : 0.6;
    }
    this.assign();
    this.sort();
  }

  /** Assign each Gaussian to a cell. Positions far outside share the cells at the border. */
  assign() {
    const { centers, count, side } = this, half = KEY_SIDE / 2;
    this.cells = new Map();
    this.keys = [];
    const along = (/** @type {number} */ value) => Math.min(KEY_SIDE - 2, Math.max(1, Math.floor(value / side) + half)) || 1; // NaN: 1
    for (let i = 0; i < count; i++) {
      const key = along(centers[3 * i]) + KEY_SIDE * (along(centers[3 * i + 1]) + KEY_SIDE * along(centers[3 * i + 2]));
      let cell = this.cells.get(key);
      if (cell === undefined) {
        cell = this.keys.length;
        this.cells.set(key, cell);
        this.keys.push(key);
      }
      this.cellOf[i] = cell;
    }
  }

  sort() {
    const { cellOf, count, items } = this, starts = new Uint32Array(this.keys.length + 1);
    for (let i = 0; i < count; i++) starts[cellOf[i] + 1]++;
    for (let cell = 0; cell < this.keys.length; cell++) starts[cell + 1] += starts[cell];
    const next = starts.slice();
    for (let i = 0; i < count; i++) items[next[cellOf[i]]++] = i;
    this.starts = starts;
  }

  /**
   * Return the Gaussians that pass a test and are connected to one of them: cells are connected if they touch and both
   * hold a Gaussian that passes.
   *
   * @param {number} seed a Gaussian that passes
   * @param {(i: number) => boolean} passes
   * @returns {number[]}
   */
  flood(seed, passes) {
    const reached = new Uint8Array(this.keys.length), waiting = [this.cellOf[seed]];
    /** @type {number[]} */
    const found = [];
    reached[waiting[0]] = 1;
    for (let cell = waiting.pop(); cell !== undefined; cell = waiting.pop()) {
      const before = found.length;
      for (let k = this.starts[cell]; k < this.starts[cell + 1]; k++) if (passes(this.items[k])) found.push(this.items[k]);
      if (found.length === before) continue;
      for (const step of AROUND) {
        const other = this.cells.get(this.keys[cell] + step);
        if (other === undefined || reached[other]) continue;
        reached[other] = 1;
        waiting.push(other);
      }
    }
    return found;
  }
}
