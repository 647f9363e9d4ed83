// A body of points, of which only those are drawn that can be seen: the rest costs a browser most of a picture's time.

/** @typedef {import("./camera.mjs").Camera} Camera */
/** @typedef {import("./data.mjs").Numbers} Numbers */
/** @typedef {(rows: Uint32Array) => ArrayLike<number>} Shade values of some points over the end of their scale */
/** @typedef {{ x: number[], across: number[] }} Cut a point of a plane, and its normal; what lies before it is left out */

const MOST_CELLS = 1 << 20;
const CELL = 1.6; // edge over the radius of a point; at larger ones holes are seen in a body
export const SLANT = [0.28, 0.175]; // of shadows, over their height

/** A body of points. */
export class Body {
  /**
   * @param {Numbers} rest [n, 3] [m]
   * @param {number} radius of a point [m]
   * @param {number[]} offset [3] [m] by which all are drawn aside
   * @param {number[] | null} tint [3] one colour for all, which then lie over other bodies and cast no shadow
   */
  constructor(rest, radius, offset, tint = null) {
    this.tint = tint;
    this.count = rest.length / 3;
    this.rest = rest;
    this.radius = radius;
    this.offset = offset;
    this.visible = true;
    /** @type {import("./surface.mjs").Surface | null} drawn in place of points, unless cut open */ this.surface = null;
    /** @type {Numbers} */ this.x = rest;
    /** @type {Shade} */ this.shade = (rows) => new Float32Array(rows.length);
    this._rows = new Uint32Array(this.count);
    this._places = new Float32Array(3 * this.count); // pixels to the right and up, and the distance from the eye [m]
    this._cells = new Int32Array(this.count);
    this._nearest = new Float32Array(0);
    this._drawn = new Float32Array(4 * this.count);
  }

  /**
   * @param {Numbers} x [n, 3] [m]
   * @param {Shade} shade
   */
  show(x, shade) {
    this.x = x;
    this.shade = shade;
  }

  /**
   * Points [m, 4] that can be seen, each with its value; the next call of either method overwrites them.
   * @param {Float32Array} view world to clip space [16], by columns
   * @param {number} wide of the picture [pixel]
   * @param {number} tall
   * @param {number} pixels that a metre takes at unit distance
   * @param {Cut | null} cut
   */
  seen(view, wide, tall, pixels, cut) {
    const rows = this._before(view, wide, tall, pixels, cut);
    return this._filled(rows, this.shade(rows));
  }

  /**
   * Points [m, 4] on a floor, one where the shadows of several lie on each other.
   * @param {number} height of the floor [m]
   * @param {Cut | null} cut
   */
  shadow(height, cut) {
    const { x, offset, count, _places: places, _rows: rows } = this, low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (let p = 0; p < count; p++)
      for (let c = 0; c < 2; c++) {
        const at = x[3 * p + c] + offset[c] + SLANT[c] * (x[3 * p + 2] + offset[2] - height);
        places[3 * p + c] = at;
        if (at < low[c]) low[c] = at;
        if (at > high[c]) high[c] = at;
      }
    const area = (high[0] - low[0]) * (high[1] - low[1]);
    const edge = Math.max(CELL * this.radius, Math.sqrt(area / MOST_CELLS)), across = Math.floor((high[0] - low[0]) / edge) + 1;
    const taken = this._grid(across * (Math.floor((high[1] - low[1]) / edge) + 1));
    let found = 0;
    for (let p = 0; p < count; p++) {
      const cell = Math.floor((places[3 * p] - low[0]) / edge) + across * Math.floor((places[3 * p + 1] - low[1]) / edge);
      if (taken[cell] === 0 || (cut && this._isCut(p, cut))) continue;
      taken[cell] = 0;
      rows[found++] = p;
    }
    const drawn = this._drawn;
    for (let k = 0; k < found; k++) drawn.set([places[3 * rows[k]], places[3 * rows[k] + 1], height, 0], 4 * k);
    return drawn.subarray(0, 4 * found);
  }

  /**
   * Rows of the points before which no others lie. A point is left out where its own cell of the picture, and all
   * cells about it, have a nearer one.
   * @param {Float32Array} m
   * @param {number} wide
   * @param {number} tall
   * @param {number} pixels
   * @param {Cut | null} cut
   */
  _before(m, wide, tall, pixels, cut) {
    const { x, offset, radius, count, _places: places, _cells: cells, _rows: rows } = this;
    let left = wide, right = 0, low = tall, high = 0, far = 0, near = Infinity, there = 0;
    for (let p = 0; p < count; p++) {
      const a = x[3 * p] + offset[0], b = x[3 * p + 1] + offset[1], c = x[3 * p + 2] + offset[2];
      const w = m[3] * a + m[7] * b + m[11] * c + m[15];
      if (!(w > 0) || (cut && this._isCut(p, cut))) continue;
      const u = wide * (0.5 + (0.5 * (m[0] * a + m[4] * b + m[8] * c + m[12])) / w);
      const v = tall * (0.5 + (0.5 * (m[1] * a + m[5] * b + m[9] * c + m[13])) / w), reach = 1 + (pixels * radius) / w;
      if (u < -reach || v < -reach || u > wide + reach || v > tall + reach) continue;
      [places[3 * there], places[3 * there + 1], places[3 * there + 2]] = [u, v, w];
      rows[there++] = p;
      left = Math.min(left, u);
      right = Math.max(right, u);
      low = Math.min(low, v);
      high = Math.max(high, v);
      far = Math.max(far, w);
      near = Math.min(near, w);
    }
    const area = Math.max(0, right - left) * Math.max(0, high - low);
    const edge = Math.max((CELL * pixels * radius) / far, 0.5, Math.sqrt(area / MOST_CELLS));
    // A row of empty cells all around, so that each has its eight neighbours.
    const across = Math.floor((right - left) / edge) + 3, down = Math.floor((high - low) / edge) + 3;
    const nearest = this._grid(there ? across * down : 0);
    for (let k = 0; k < there; k++) {
      const cell = Math.floor((places[3 * k] - left) / edge) + 1 + across * (Math.floor((places[3 * k + 1] - low) / edge) + 1);
      cells[k] = cell;
      if (places[3 * k + 2] < nearest[cell]) nearest[cell] = places[3 * k + 2];
    }
    let found = 0;
    for (let k = 0; k < there; k++) {
      const cell = cells[k], w = places[3 * k + 2] - 0.5 * radius;
      const hidden = w > nearest[cell]
        && w > nearest[cell - 1] && w > nearest[cell + 1] && w > nearest[cell - across] && w > nearest[cell + across]
        && w > nearest[cell - across - 1] && w > nearest[cell - across + 1]
        && w > nearest[cell + across - 1] && w > nearest[cell + across + 1];
      if (!hidden) rows[found++] = rows[k];
    }
    return rows.subarray(0, found);
  }

  /** @param {number} p @param {Cut} cut */
  _isCut(p, { x, across }) {
    const { rest } = this;
    return (rest[3 * p] - x[0]) * across[0] + (rest[3 * p + 1] - x[1]) * across[1] > 0;
  }

  /** @param {number} size */
  _grid(size) {
    if (this._nearest.length < size) this._nearest = new Float32Array(size);
    return this._nearest.fill(Infinity, 0, size);
  }

  /** @param {Uint32Array} rows @param {ArrayLike<number>} values */
  _filled(rows, values) {
    const { x, offset, _drawn: drawn } = this;
    for (let k = 0; k < rows.length; k++) {
      const p = 3 * rows[k];
      for (let c = 0; c < 3; c++) drawn[4 * k + c] = x[p + c] + offset[c];
      drawn[4 * k + 3] = values[k];
    }
    return drawn.subarray(0, 4 * rows.length);
  }
}
