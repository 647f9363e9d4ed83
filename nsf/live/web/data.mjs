// What a page holds: arrays in one piece behind a header, as `nsf.live.page.packed` writes them.

/** @typedef {Float32Array | Float64Array | Int8Array | Int16Array | Uint8Array | Uint16Array} Numbers */
/** @typedef {{ header: any, arrays: Record<string, Numbers> }} Packed */

const KINDS = { f4: Float32Array, f8: Float64Array, i1: Int8Array, i2: Int16Array, u1: Uint8Array, u2: Uint16Array };
const WORD = 8; // every array begins at a whole word, so that it is viewed in place

/**
 * The header and the arrays of a buffer.
 * @param {ArrayBuffer} buffer
 * @returns {Packed}
 */
export function unpacked(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  /** @type {Record<string, Numbers>} */
  const arrays = {};
  let at = 4 + length;
  for (const [name, { shape, type }] of Object.entries(header.arrays)) {
    const Kind = KINDS[/** @type {keyof typeof KINDS} */ (type)];
    const values = new Kind(buffer, at, shape.reduce((/** @type {number} */ a, /** @type {number} */ b) => a * b, 1));
    arrays[name] = values;
    at += Math.ceil(values.byteLength / WORD) * WORD;
  }
  return { header, arrays };
}

/**
 * The buffer behind text: base64 of what zlib deflated.
 * @param {string} text
 * @returns {Promise<ArrayBuffer>}
 */
export async function inflated(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/**
 * Planes of whole numbers from their differences, each from the plane before; low bytes come before high ones.
 * @param {Uint8Array} bytes of all planes
 * @param {number} size of a plane
 * @param {1 | 2} width bytes of a number
 * @returns {Uint8Array | Uint16Array}
 */
export function undifferenced(bytes, size, width) {
  const count = bytes.length / width;
  const found = width === 2 ? new Uint16Array(count) : new Uint8Array(count);
  for (let i = 0; i < count; i++) {
    const here = width === 2 ? bytes[i] + 256 * bytes[count + i] : bytes[i];
    found[i] = here + (i < size ? 0 : found[i - size]);
  }
  return found;
}

/**
 * A recorded run: positions in 16 bits over a box, von Mises stress in 8 bits over its scale.
 */
export class Recording {
  /**
   * @param {Packed} packed
   * @param {string} name of the run among those that are packed
   */
  constructor({ header, arrays }, name) {
    const told = header.recordings[name];
    /** @type {number[]} */ this.t = told.t;
    /** @type {number} */ this.points = told.points;
    /** @type {number[]} */ this.lower = told.lower;
    /** @type {number[]} */ this.upper = told.upper;
    this.frames = this.t.length;
    this.planes = undifferenced(/** @type {Uint8Array} */ (arrays[`${name}.x`]), 3 * this.points, 2);
    this.stresses = undifferenced(/** @type {Uint8Array} */ (arrays[`${name}.stress`]), this.points, 1);
    this.rest = this._placed(0, 0, 0, new Float32Array(3 * this.points));
    this.x = this.rest.slice();
  }

  /**
   * Positions [n, 3], which the next call overwrites, and how von Mises stress of some points is found, over the end of
   * its scale; in a frame or between two of them.
   * @param {number} frame
   */
  at(frame) {
    const k = Math.min(Math.max(0, Math.floor(frame)), this.frames - 1), after = Math.min(k + 1, this.frames - 1);
    const part = Math.min(1, Math.max(0, frame - k)), { stresses, points } = this;
    this._placed(k + 1, after + 1, part, this.x);
    const stress = (/** @type {number} */ p) => ((1 - part) * stresses[k * points + p] + part * stresses[after * points + p]) / 255;
    return { x: this.x, stressOf: (/** @type {Uint32Array} */ rows) => Float32Array.from(rows, stress) };
  }

  /**
   * The frame at a time, with its fraction.
   * @param {number} t [s]
   */
  frameAt(t) {
    const times = this.t;
    let k = 0;
    while (k < times.length - 2 && times[k + 1] < t) k++;
    if (times.length < 2) return 0;
    return k + Math.min(1, Math.max(0, (t - times[k]) / (times[k + 1] - times[k])));
  }

  /**
   * @param {number} one plane
   * @param {number} other plane
   * @param {number} part of the way between them
   * @param {Float32Array} x
   */
  _placed(one, other, part, x) {
    const { planes, lower, upper } = this, size = 3 * this.points;
    for (let c = 0; c < 3; c++) {
      const unit = (upper[c] - lower[c]) / 65535;
      for (let i = c; i < size; i += 3)
        x[i] = lower[c] + unit * ((1 - part) * planes[one * size + i] + part * planes[other * size + i]);
    }
    return x;
  }
}
