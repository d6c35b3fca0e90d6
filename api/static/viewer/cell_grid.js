// @ts-check
/** Grid of cells over the centers of a scene's Gaussians, for searches among neighbors. */

/** Bits of a cell's position along an axis, in the keys of cells. */
const SIDE = 2 ** 16;
/** Wanted mean number of Gaussians in an occupied cell. */
const FEWEST = 3, MOST = 24;
/** Steps along an axis to a cell and its neighbors. */
const STEPS = [0, -1, 1];
/** Steps to the 27 cells around a cell, itself first, as differences of keys. */
const AROUND = STEPS.flatMap((z) => STEPS.flatMap((y) => STEPS.map((x) => x + SIDE * (y + SIDE * z))));

export class CellGrid {
  /**
   * @param {Float32Array} centers [n * 3]
   * @param {number} count
   * @param {number} radius radius of the bulk of the scene
   */
  constructor(centers, count, radius) {
    this.centers = centers;
    this.count = count;
    /** Side of a cell, which is about twice the distance between neighbors on a surface. */
    this.side = Math.max((7 * radius) / Math.sqrt(Math.max(count, 1)), 1e-9);
    /** Cell of each Gaussian. */
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
    const { centers, count, side } = this, half = SIDE / 2;
    this.cells = new Map();
    this.keys = [];
    const along = (/** @type {number} */ value) => Math.min(SIDE - 2, Math.max(1, Math.floor(value / side) + half)) || 1; // NaN: 1
    for (let i = 0; i < count; i++) {
      const key = along(centers[3 * i]) + SIDE * (along(centers[3 * i + 1]) + SIDE * along(centers[3 * i + 2]));
      let cell = this.cells.get(key);
      if (cell === undefined) {
        cell = this.keys.length;
        this.cells.set(key, cell);
        this.keys.push(key);
      }
      this.cellOf[i] = cell;
    }
  }

  /** List the Gaussians cell by cell. */
  sort() {
    const { cellOf, count, items } = this, starts = new Uint32Array(this.keys.length + 1);
    for (let i = 0; i < count; i++) starts[cellOf[i] + 1]++;
    for (let cell = 0; cell < this.keys.length; cell++) starts[cell + 1] += starts[cell];
    const next = starts.slice();
    for (let i = 0; i < count; i++) items[next[cellOf[i]]++] = i;
    this.starts = starts;
  }

  /** Return the occupied cells around a cell, itself first. @param {number} cell */
  around(cell) {
    const key = this.keys[cell], found = [];
    for (const step of AROUND) {
      const other = this.cells.get(key + step);
      if (other !== undefined) found.push(other);
    }
    return found;
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
      for (const other of this.around(cell)) {
        if (reached[other]) continue;
        reached[other] = 1;
        waiting.push(other);
      }
    }
    return found;
  }

  /**
   * Return the Gaussians without a flag whose center is at most one side of a cell away from that of one with a flag.
   *
   * @param {Uint8Array} flags
   * @returns {number[]}
   */
  border(flags) {
    const { centers, items, starts, side } = this, marked = new Uint8Array(this.keys.length), open = new Uint8Array(this.keys.length);
    for (let i = 0; i < this.count; i++) (flags[i] ? marked : open)[this.cellOf[i]] = 1;
    /** @type {number[]} */
    const found = [];
    /** @type {number[]} */
    const flagged = [];
    for (let cell = 0; cell < open.length; cell++) {
      if (!open[cell]) continue;
      flagged.length = 0; // those of the cell itself are first: most are close enough
      for (const other of this.around(cell)) {
        if (marked[other]) for (let k = starts[other]; k < starts[other + 1]; k++) if (flags[items[k]]) flagged.push(items[k]);
      }
      if (!flagged.length) continue;
      for (let k = starts[cell]; k < starts[cell + 1]; k++) {
        const i = items[k], x = centers[3 * i], y = centers[3 * i + 1], z = centers[3 * i + 2];
        if (!flags[i] && flagged.some((j) => (centers[3 * j] - x) ** 2 + (centers[3 * j + 1] - y) ** 2 + (centers[3 * j + 2] - z) ** 2 <= side * side)) found.push(i);
      }
    }
    return found;
  }
}
