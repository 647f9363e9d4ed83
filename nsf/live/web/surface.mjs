// The closed surface of a body: triangles through its outer points, smooth and lit.

/** @typedef {import("./body.mjs").Body} Body */

// Steps of Taubin, 1995, to and fro, which take the roughness of points from a surface and leave its size.
const SMOOTHING = Array.from({ length: 12 }, (_, k) => (k % 2 ? -0.63 : 0.6));

/** A surface of triangles between points of a body. */
export class Surface {
  /**
   * @param {ArrayLike<number>} rows [V] of the body's points that are its corners
   * @param {ArrayLike<number>} faces [3 m] corners of triangles, anticlockwise as seen from outside
   */
  constructor(rows, faces) {
    this.rows = Uint32Array.from(rows);
    this.faces = Uint16Array.from(faces);
    /** @type {Set<number>[]} */ const beside = Array.from(this.rows, () => new Set());
    for (let f = 0; f < faces.length; f++) beside[faces[f]].add(faces[f - (f % 3) + ((f + 1) % 3)]);
    this.neighbours = Uint16Array.from(beside.flatMap((own) => [...own]));
    this.ends = Uint32Array.from(beside.map(() => 0));
    beside.reduce((sum, own, v) => (this.ends[v] = sum + own.size), 0);
    this._places = [0, 1].map(() => new Float32Array(3 * this.rows.length));
    this._drawn = new Float32Array(7 * this.rows.length);
  }

  /** That of a page, if it has one. @param {Record<string, any>} arrays @returns {Surface | null} */
  static of({ corners, faces }) {
    return faces ? new Surface(corners, faces) : null;
  }

  /**
   * Corners [V, 7]: where they are [m], the normal, and the value; the next call overwrites them.
   * @param {Body} body
   */
  corners({ x, offset, shade }) {
    const { rows, faces, _drawn: drawn } = this, at = this._smoothed(x), values = shade(rows);
    drawn.fill(0);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const ux = at[b] - at[a], uy = at[b + 1] - at[a + 1], uz = at[b + 2] - at[a + 2];
      const vx = at[c] - at[a], vy = at[c + 1] - at[a + 1], vz = at[c + 2] - at[a + 2];
      const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      for (let k = 0; k < 3; k++) {
        const to = 7 * faces[f + k] + 3;
        drawn[to] += nx;
        drawn[to + 1] += ny;
        drawn[to + 2] += nz;
      }
    }
    for (let v = 0, i = 0, to = 0; v < rows.length; v++, i += 3, to += 7) {
      const size = Math.hypot(drawn[to + 3], drawn[to + 4], drawn[to + 5]) || 1;
      for (let c = 0; c < 3; c++) {
        drawn[to + c] = at[i + c] + offset[c];
        drawn[to + 3 + c] /= size;
      }
      drawn[to + 6] = values[v];
    }
    return drawn;
  }

  /** Smooth places of the corners [V, 3]. @param {import("./data.mjs").Numbers} x [n, 3] of the body */
  _smoothed(x) {
    const { rows, neighbours, ends } = this;
    let [from, to] = this._places;
    for (let v = 0; v < rows.length; v++) for (let c = 0; c < 3; c++) from[3 * v + c] = x[3 * rows[v] + c];
    for (const share of SMOOTHING) {
      for (let v = 0, n = 0, i = 0; v < rows.length; v++, i += 3) {
        let sx = 0, sy = 0, sz = 0;
        const first = n;
        for (; n < ends[v]; n++) {
          const j = 3 * neighbours[n];
          sx += from[j];
          sy += from[j + 1];
          sz += from[j + 2];
        }
        const part = share / (n - first || 1), own = n === first ? 1 : 1 - share;
        to[i] = own * from[i] + part * sx;
        to[i + 1] = own * from[i + 1] + part * sy;
        to[i + 2] = own * from[i + 2] + part * sz;
      }
      [from, to] = [to, from];
    }
    return from;
  }
}
