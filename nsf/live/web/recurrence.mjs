// Strides of the latent state, as `nsf.recurrence` takes them:
//     d' = d + B d + f + G g + A ŝ,    x̂ ← x̂ + d',    ŝ ← ŝ + H d' + k,    d = x̂_n − x̂_{n−1},
// where B, f, G and A follow from x̂, μ and the solids c, and H and k from ŝ and d' as well.
// Networks are stored for raw inputs and outputs; the stride's length squared is in f, G and A.

import { Network } from "./field.mjs";
import { stateOf, valueAt } from "./solids.mjs";

/** @typedef {import("./data.mjs").Packed} Packed */
/** @typedef {import("./field.mjs").Vector} Vector */
/** @typedef {import("./solids.mjs").Solid} Solid */
/** @typedef {import("./solids.mjs").Keyframes} Keyframes */
/** @typedef {{ xhat: Float64Array, change: Float64Array, stress: Float64Array }} State of one member */

/** The recurrence of the latent state, of several members. */
export class Recurrence {
  /** @param {Packed} packed */
  constructor(packed) {
    const told = packed.header.recurrence;
    /** @type {number} */ this.latents = told.latents;
    /** @type {number} */ this.stress = told.stress;
    /** @type {number} */ this.stride = told.stride;
    /** @type {boolean} */ this.gravity = told.gravity;
    const networks = (/** @type {string} */ kind) =>
      Array.from({ length: told.members }, (_, member) => new Network(packed, `${kind}${member}`, told.layers));
    this.motions = networks("motion");
    this.stresses = this.stress ? networks("stress") : [];
  }

  /**
   * States of all members at t = 0.
   * @param {{ xhat: number[], change: number[] }} start x̂_0 and what stands for d
   * @returns {State[]}
   */
  begin({ xhat, change }) {
    const copy = () => ({ xhat: Float64Array.from(xhat), change: Float64Array.from(change), stress: new Float64Array(this.stress) });
    return this.motions.map(copy);
  }

  /**
   * States of all members after a stride.
   * @param {State[]} states
   * @param {Vector} parameters [n]
   * @param {Vector} gravity [3] [m/s²], the mean over the stride
   * @param {Vector} solids [f] states of the solids, the mean over the stride
   */
  step(states, parameters, gravity, solids) {
    const terms = this.gravity ? Array.from(gravity) : [];
    return states.map(({ xhat, change, stress }, member) => {
      const seen = [xhat, parameters, solids];
      const next = added(change, outputsOf(this.motions[member], seen), [...change, 1, ...terms, ...stress]);
      const of = this.stresses[member];
      return {
        xhat: xhat.map((value, i) => value + next[i]),
        change: next,
        stress: of ? added(stress, outputsOf(of, [...seen, stress, next]), [...next, 1]) : stress,
      };
    });
  }
}

/**
 * @param {Network} network
 * @param {Vector[]} seen
 */
function outputsOf(network, seen) {
  let at = 0;
  for (const values of seen) {
    network.inputs.set(values, at);
    at += values.length;
  }
  return network.outputs();
}

/**
 * values + matrix · terms.
 * @param {Float64Array} values [rows]
 * @param {Float64Array} matrix [rows, terms]
 * @param {number[]} terms
 */
function added(values, matrix, terms) {
  return values.map((value, i) => {
    let sum = value;
    for (let j = 0, m = i * terms.length; j < terms.length; j++) sum += matrix[m + j] * terms[j];
    return sum;
  });
}

/**
 * The mean of rows.
 * @param {Vector[]} rows
 */
function mean(rows) {
  return Float64Array.from(rows[0], (_, i) => rows.reduce((sum, row) => sum + row[i], 0) / rows.length);
}

/** A run: every latent vector since t = 0, under the forcing of the moment. It goes on by whole strides. */
export class Run {
  /**
   * @param {Recurrence} recurrence
   * @param {{ xhat: number[], change: number[] }} start x̂_0 and what stands for d at t = 0
   * @param {number} dt [s]
   * @param {number} most steps that are kept
   */
  constructor(recurrence, start, dt, most) {
    this.recurrence = recurrence;
    this.start = start;
    this.dt = dt;
    this.most = most;
    /** @type {number[]} */ this.parameters = [];
    /** @type {Keyframes} */ this.program = { times: [0], values: [[0, 0, 0]] };
    /** @type {Solid[]} */ this.solids = [];
    /** @type {Float64Array[]} x̂ of each step */ this.latents = [];
    /** @type {Float64Array[]} ŝ of each step */ this.stresses = [];
    /** @type {State[][]} of all members, at each stride */ this.states = [];
    /** @type {number[][]} gravity of each step */ this.gravities = [];
    /** @type {number[][]} parameters of each step */ this.given = [];
    /** @type {(number[] | null)[]} gravity of a hand in each step */ this.hands = [];
    /** @type {number[] | null} gravity of a hand from now on */ this.hand = null;
    this.diverged = false;
    this.restart();
  }

  /** Number of steps taken, a multiple of the stride. */
  get steps() {
    return this.latents.length - 1;
  }

  /** Go back to t = 0, and give gravity back to the program. */
  restart() {
    this.hands = [];
    this.hand = null;
    this._begin();
  }

  _begin() {
    this.states = [this.recurrence.begin(this.start)];
    this.latents = [Float64Array.from(this.start.xhat)];
    this.stresses = [new Float64Array(this.recurrence.stress)];
    this.gravities = [];
    this.given = [];
    this.diverged = false;
  }

  /**
   * The same run with other parameters or another program, as far as it had come.
   * @param {number} steps
   */
  again(steps) {
    this._begin();
    this.advance(steps);
  }

  /**
   * Go on from the start of the stride of an earlier step; what came after it is forgotten.
   * @param {number} step
   */
  rewind(step) {
    if (step >= this.steps) return;
    const strides = Math.floor(step / this.recurrence.stride), kept = strides * this.recurrence.stride;
    this.states.length = strides + 1;
    this.latents.length = this.stresses.length = kept + 1;
    this.gravities.length = this.given.length = kept;
    this.hands.length = Math.min(this.hands.length, kept);
    this.diverged = false;
  }

  /**
   * Gravity [3] [m/s²] of a step.
   * @param {number} n
   */
  gravityAt(n) {
    const byHand = n < this.hands.length ? this.hands[n] : this.hand;
    return byHand ?? valueAt(this.program, n * this.dt);
  }

  /**
   * Take strides of at least so many steps, as far as they are kept; fewer where the latent vector ceases to be finite.
   * @param {number} count of steps
   */
  advance(count) {
    const { stride } = this.recurrence, end = Math.min(this.steps + count, this.most - stride + 1);
    while (this.steps < end && !this.diverged) {
      const n = this.steps, steps = Array.from({ length: stride }, (_, j) => n + j);
      const gravity = steps.map((step) => this.gravityAt(step)), solids = steps.map((step) => stateOf(this.solids, step, this.dt));
      const states = this.recurrence.step(this.states[n / stride], this.parameters, mean(gravity), mean(solids));
      if (!states.every(({ xhat }) => xhat.every(Number.isFinite))) {
        this.diverged = true;
        return;
      }
      this.states.push(states);
      this._between(stride);
      for (const step of steps) {
        if (step >= this.hands.length) this.hands.push(this.hand);
        this.gravities.push(gravity[step - n]);
        this.given.push(this.parameters);
      }
    }
  }

  /**
   * x̂ of the steps of the last stride, on the parabola through its ends and the one before them, and ŝ, linear.
   * @param {number} stride
   */
  _between(stride) {
    const [before, after] = this.states.slice(-2);
    const [x, d, next] = [before.map((own) => own.xhat), before.map((own) => own.change), after.map((own) => own.change)].map(mean);
    const [s, later] = [before, after].map((own) => mean(own.map(({ stress }) => stress)));
    const end = mean(after.map((own) => own.xhat));
    for (let j = 1; j <= stride; j++) {
      const part = j / stride;
      this.latents.push(j === stride ? end : x.map((value, i) => value + 0.5 * part * (d[i] + next[i] + part * (next[i] - d[i]))));
      this.stresses.push(s.map((value, i) => value + part * (later[i] - value)));
    }
  }
}
