// Whether a run by a recurrence is to be believed, and why not, as far as a page can tell without a projected step.

/** @typedef {import("./data.mjs").Packed} Packed */
/** @typedef {import("./field.mjs").Field} Field */
/** @typedef {import("./field.mjs").Vector} Vector */
/** @typedef {{ level: "good" | "away" | "bad", text: string, ratio: number }} Light */

/**
 * A number and its unit, as text.
 * @param {number} value
 * @param {string} unit
 * @param {number} [digits] that count
 */
export function quantity(value, unit, digits = 3) {
  const shown = Number(value.toPrecision(digits));
  if (unit === "°") return `${shown}°`;
  return ["", "-", "1"].includes(unit) ? `${shown}` : `${shown} ${unit}`;
}

/** How far a moment is from what the model was trained and taught on. */
export class Trust {
  /**
   * @param {Packed} packed
   * @param {Field} deformation
   */
  constructor({ header, arrays }, deformation) {
    this.told = header.trust;
    /** @type {{ name: string, unit: string, trained: number[] }[]} */ this.parameters = header.parameters;
    this.deformation = deformation;
    this.matrix = arrays["tube.matrix"]; // [q, K]: distances of its products are those of S [m]
    const scale = arrays["tube.scale"], known = arrays["tube.known"];
    this.known = Float32Array.from(known, (value, i) => value * scale[i % scale.length]);
    this.width = scale.length;
  }

  /**
   * How far the parameters are from the training cases, in units of their spacing; above 1 outside their box.
   * @param {Vector} parameters
   */
  ofCase(parameters) {
    const { cases, deviation, spacing } = this.told.cases;
    if (!cases.length) return 0;
    const size = (/** @type {number[]} */ values) => Math.hypot(...values) / spacing;
    const off = this.parameters.map(({ trained: [low, high] }, i) => {
      const beyond = Math.max(low - parameters[i], parameters[i] - high, 0);
      return beyond > 1e-6 * Math.max(Math.abs(low), Math.abs(high)) ? beyond / deviation[i] : 0;
    });
    const nearest = Math.min(
      ...cases.map((/** @type {number[]} */ own) => size(own.map((v, i) => (v - parameters[i]) / deviation[i]))),
    );
    return Math.max(nearest, size(off) > 0 ? 1 + size(off) : 0);
  }

  /**
   * How far x̂ is from the nearest training snapshot at the sample particles, over the scale of such distances.
   * @param {Vector} xhat
   */
  ofLatent(xhat) {
    const { matrix, known, width } = this, a = this.deformation.coefficientsAt(xhat, []), K = a.length;
    const y = Float64Array.from({ length: width }, (_, q) => {
      let sum = 0;
      for (let k = 0; k < K; k++) sum += matrix[q * K + k] * a[k];
      return sum;
    });
    let nearest = Infinity;
    for (let row = 0; row < known.length; row += width) {
      let sum = 0;
      for (let q = 0; q < width; q++) sum += (y[q] - known[row + q]) ** 2;
      if (sum < nearest) nearest = sum;
    }
    return Math.sqrt(nearest) / this.told.distance;
  }

  /**
   * How far gravity is from the middle of what was taught, over its reach.
   * @param {Vector} gravity
   */
  ofGravity(gravity) {
    const range = this.told.gravity;
    if (!range) return 0;
    const away = Math.hypot(...range.middle.map((/** @type {number} */ v, /** @type {number} */ i) => gravity[i] - v));
    return away / Math.max(range.reach, 1e-12);
  }

  /**
   * The light.
   * @param {Vector} parameters of the run
   * @param {number} tube largest `ofLatent` so far
   * @param {number} gravity largest `ofGravity` so far
   * @param {number | null} diverged time at which the run ceased to be finite [s]
   * @param {number | null} estimate estimated error of the run, as its deployment had it [m]
   * @returns {Light}
   */
  light(parameters, tube, gravity, diverged = null, estimate = null) {
    const away = this.ofCase(parameters), ratio = Math.max(tube, away > 1 ? away : 0, gravity > 1 ? gravity : 0);
    if (diverged !== null) return { level: "bad", text: `diverged at t = ${quantity(diverged, "s")}`, ratio: Infinity };
    const outside = this.parameters.findIndex(({ trained: [low, high] }, i) => {
      const slack = 1e-6 * Math.max(Math.abs(low), Math.abs(high));
      return parameters[i] < low - slack || parameters[i] > high + slack;
    });
    if (outside >= 0) {
      const { name, unit, trained } = this.parameters[outside];
      const [low, high] = trained.map((value) => quantity(value, unit));
      return { level: "bad", text: `distrusted: ${name} is outside of the training values, ${low} to ${high}`, ratio };
    }
    if (gravity > 1 + 1e-6) {
      const { reach } = this.told.gravity;
      const [was, most] = [gravity * reach, reach].map((value) => quantity(value, "m/s²"));
      const text = `distrusted: gravity was ${was} from that which was taught, ${most} at most`;
      return { level: "bad", text, ratio };
    }
    if (tube > 1)
      return { level: "bad", text: `distrusted: the shape left the training runs, ratio ${tube.toFixed(2)}, above 1`, ratio };
    if (away > 1)
      return { level: "away", text: `away from the training cases, ratio ${away.toPrecision(3)}, above 1`, ratio };
    if (estimate !== null && estimate > this.told.distance) {
      const [most, scale] = [estimate, this.told.distance].map((value) => quantity(1000 * value, "mm", 2));
      const text = `the run may be ${most} off; training runs are ${scale} from each other`;
      return { level: "away", text, ratio };
    }
    return { level: "good", text: `distrust ratio ${ratio.toFixed(2)}, below 1`, ratio };
  }
}

/**
 * The light of a run that a server takes, as `nsf view` has it.
 * @param {number} trust largest distrust ratio so far
 * @param {number} away how far the case is from the training cases
 * @param {boolean} diverged
 * @param {number} t [s]
 * @returns {Light}
 */
export function lightOf(trust, away, diverged, t) {
  if (diverged) return { level: "bad", text: `diverged at t = ${quantity(t, "s")}`, ratio: Infinity };
  if (trust > 1) return { level: "bad", text: `distrusted: ratio ${trust.toFixed(2)}, above 1`, ratio: trust };
  if (away > 1)
    return { level: "away", text: `away from the training cases: ratio ${away.toPrecision(3)}, above 1`, ratio: away };
  return { level: "good", text: `distrust ratio ${trust.toFixed(2)}, below 1`, ratio: trust };
}
