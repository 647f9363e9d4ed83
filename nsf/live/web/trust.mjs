// The bound of a run's error, and whether to believe the run, as `nsf.deployment.trust` has it.

/** @typedef {import("./data.mjs").Packed} Packed */
/** @typedef {import("./field.mjs").Vector} Vector */
/** @typedef {import("./recurrence.mjs").Run} Run */
/** @typedef {"green" | "amber" | "red" | "unknown"} Flag */
/** @typedef {{ level: Flag, text: string }} Light */
/** @typedef {{ signal: number, moved: number, left: boolean, gravity: number }} Look at one stride */

const ROUND_OFF = 1e-6; // of a value: what float32 may have moved it by
const AWAY = 0.5; // growth of a bound a side of the box of parameters away from the nearest validation case

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

/**
 * The light of an error and its bound, shares of the displacement; NaN where nothing tells.
 * @param {number} error
 * @param {number} bound
 * @param {number} limit
 * @param {string} reason
 * @param {Flag | null} flag where it is known already
 * @returns {Light}
 */
export function lightOf(error, bound, limit, reason, flag = null) {
  const level = flag ?? (Number.isNaN(bound) ? "unknown" : bound <= 0.5 * limit ? "green" : bound <= limit ? "amber" : "red");
  const percent = (/** @type {number} */ share) => (Number.isFinite(share) ? quantity(100 * share, "%") : "∞");
  const errors = Number.isNaN(bound) ? "" : `expected error ${percent(error)}, at most ${percent(bound)} of the displacement`;
  return { level, text: `${level}: ${[errors, reason].filter(Boolean).join("; ")}` };
}

/** Root mean square over time, by the trapezoidal rule. @param {number[]} values at even steps */
function rms(values) {
  const last = values.length - 1, square = (/** @type {number} */ k) => values[k] * values[k];
  if (!last) return Math.abs(values[0]);
  return Math.sqrt((values.reduce((sum, _, k) => sum + square(k), 0) - 0.5 * (square(0) + square(last))) / last);
}

/**
 * Values at times, linear between them and constant beyond.
 * @param {number[]} times
 * @param {number[]} values
 * @param {number} t
 */
function between(times, values, t) {
  const k = times.findIndex((time) => time > t);
  if (k <= 0) return k === 0 ? values[0] : values[values.length - 1];
  const part = (t - times[k - 1]) / (times[k] - times[k - 1]);
  return values[k - 1] + part * (values[k] - values[k - 1]);
}

/** Judges runs by a recurrence of several members, from what their strides say. */
export class Trust {
  /** @param {Packed} packed */
  constructor({ header }) {
    /** @type {any} */ this.told = header.trust ?? {};
    /** @type {{ name: string, unit: string }[]} */ this.parameters = header.parameters;
    /** @type {Look[]} */ this.looks = [];
  }

  /** Forget what came after a number of strides. @param {number} strides */
  forget(strides = 0) {
    this.looks.length = Math.min(this.looks.length, strides);
  }

  /**
   * The light of a run up to a step.
   * @param {Run} run
   * @param {Vector} parameters
   * @param {number} step
   * @param {boolean} whole whether it is at the end of the scene
   * @returns {Light}
   */
  light(run, parameters, step, whole) {
    const { told, looks } = this, { stride } = run.recurrence, last = Math.min(Math.floor(step / stride), run.states.length - 1);
    if (!told.metric || run.recurrence.motions.length < 2) return lightOf(NaN, NaN, 1, "this page has no bound of the error");
    while (looks.length <= last) looks.push(this._look(run, looks.length));
    const seen = looks.slice(0, last + 1), diverged = run.diverged && step >= run.steps;
    const reason = this._outside(parameters, Math.max(...seen.map(({ gravity }) => gravity)), seen.findIndex(({ left }) => left) * stride * run.dt);
    const { calibration, limit } = told, more = reason || (diverged ? `it diverged at t = ${quantity(step * run.dt, "s")}` : "");
    if (!calibration) return lightOf(NaN, NaN, limit, more || "no validation run tells (set scene.design.validation)", reason || diverged ? "red" : null);
    const own = rms(seen.map(({ moved }) => moved)), D = whole ? own : Math.max(own, calibration.displacement);
    const base = seen.map(({ signal }, k) => Math.max(D * between(calibration.t, calibration.curve, k * stride * run.dt), calibration.slope * signal));
    const expected = D > 0 ? (this._away(parameters) * rms(base)) / D : 0, of = (/** @type {number | null} */ factor) => (diverged ? Infinity : expected * (factor ?? Infinity));
    const few = calibration.errors.length === 1 ? "the bound is coarse, of one validation run" : calibration.errors.length ? "" : "every validation run was lost";
    return lightOf(of(calibration.typical), of(calibration.factor), limit, more || few, reason ? "red" : null);
  }

  /**
   * What the members say at a stride.
   * @param {Run} run
   * @param {number} stride
   * @returns {Look}
   */
  _look(run, stride) {
    const members = run.states[stride].map(({ xhat }) => this._metres(xhat)), M = members.length;
    const mean = members[0].map((_, j) => members.reduce((sum, own) => sum + own[j], 0) / M), start = this._metres(run.start.xhat);
    const squares = members.reduce((sum, own) => sum + own.reduce((part, value, j) => part + (value - mean[j]) ** 2, 0), 0);
    const { low, high, leeway } = this.told.reach.states;
    const slack = low.map((/** @type {number} */ value, /** @type {number} */ j) => ROUND_OFF * Math.max(Math.abs(value), Math.abs(high[j])));
    const beyond = mean.map((value, j) => Math.max(low[j] - slack[j] - value, value - high[j] - slack[j], 0));
    const size = 0.5 * Math.hypot(...high.map((/** @type {number} */ value, /** @type {number} */ j) => value - low[j])) || 1;
    const { gravity } = this.told.reach, steps = run.gravities.slice(Math.max(0, stride - 1) * run.recurrence.stride, stride * run.recurrence.stride);
    return {
      signal: Math.sqrt(squares / (M - 1)),
      moved: Math.hypot(...mean.map((value, j) => value - start[j])),
      left: Math.hypot(...beyond) / size > leeway || this._rare(mean),
      gravity: Math.max(0, ...steps.map((acting) => Math.hypot(...acting.map((value, i) => value - gravity[i])))),
    };
  }

  /** Whether few of the runs that taught come near to a state in metres. @param {number[]} state */
  _rare(state) {
    const { usual } = this.told.reach;
    return Boolean(usual) && !usual.rows.some((/** @type {number[]} */ row) => Math.hypot(...row.map((value, j) => value - state[j])) <= usual.leeway);
  }

  /**
   * Why a run is outside of what was taught; empty where it is not.
   * @param {Vector} parameters
   * @param {number} gravity largest distance from the middle of what was taught [m/s²]
   * @param {number} left time at which the shape left those of training [s]; negative: at none
   */
  _outside(parameters, gravity, left) {
    const { box, radius, gravity: middle, changed } = this.told.reach;
    if (changed) return `deploy.changes has ${changed}, which no training run had`;
    for (const [i, [low, high]] of box.entries()) {
      const slack = ROUND_OFF * Math.max(Math.abs(low), Math.abs(high)), { name, unit } = this.parameters[i];
      if (parameters[i] >= low - slack && parameters[i] <= high + slack) continue;
      return `${name}=${quantity(parameters[i], unit)} is outside of ${quantity(low, "")} … ${quantity(high, "")}`;
    }
    if (gravity > radius + ROUND_OFF * (radius + Math.hypot(...middle)))
      return `gravity is ${quantity(gravity, "m/s²")} from that which was taught, ${quantity(radius, "m/s²")} at most`;
    return left >= 0 ? `its shape left those of the training runs at t = ${quantity(left, "s")}` : "";
  }

  /** Factor on a bound, the further away from validation cases. @param {Vector} parameters */
  _away(parameters) {
    const { validated, reach } = this.told;
    if (!validated.length || !reach.box.length) return 1;
    const sides = validated.map((/** @type {number[]} */ own) =>
      Math.max(0, ...reach.box.map((/** @type {number[]} */ [low, high], /** @type {number} */ i) => (high > low ? Math.abs(own[i] - parameters[i]) / (high - low) : 0))));
    return 1 + AWAY * Math.min(...sides);
  }

  /** Latent vector in metres. @param {Vector} xhat @returns {number[]} */
  _metres(xhat) {
    const { metric } = this.told;
    return metric.map((/** @type {unknown} */ _, /** @type {number} */ j) => metric.reduce((/** @type {number} */ sum, /** @type {number[]} */ row, /** @type {number} */ i) => sum + xhat[i] * row[j], 0));
  }
}
