// Steps of the latent vector by operators, as `nsf.engines.operators` takes them:
//     d' = d + B(x̂, μ, c) d + f(x̂, μ, c) + G(x̂, μ, c) g,    x̂ ← x̂ + d',    d = x̂_n − x̂_{n−1}.
// The network is stored for raw inputs and outputs; Δt² is in f and G.

import { Network } from "./field.mjs";
import { stateOf, valueAt } from "./solids.mjs";

/** @typedef {import("./data.mjs").Packed} Packed */
/** @typedef {import("./field.mjs").Vector} Vector */
/** @typedef {import("./solids.mjs").Solid} Solid */
/** @typedef {import("./solids.mjs").Keyframes} Keyframes */

/** The recurrence of the latent vector. */
export class Operators {
  /** @param {Packed} packed */
  constructor(packed) {
    const told = packed.header.operators;
    /** @type {number} */ this.latents = told.latents;
    /** @type {boolean} */ this.gravity = told.gravity;
    this.network = new Network(packed, "operators", told.layers);
    this.next = new Float64Array(this.latents);
  }

  /**
   * Take one step, in place.
   * @param {Float64Array} xhat [r]
   * @param {Float64Array} change d [r]
   * @param {Vector} parameters [n]
   * @param {Vector} gravity [3] [m/s²]
   * @param {Vector} states of the solids [f]
   */
  step(xhat, change, parameters, gravity, states) {
    const r = this.latents, { network, next } = this;
    network.inputs.set(xhat);
    network.inputs.set(parameters, r);
    network.inputs.set(states, r + parameters.length);
    const out = network.outputs();
    for (let i = 0; i < r; i++) {
      let sum = change[i] + out[r * r + i];
      for (let j = 0; j < r; j++) sum += out[i * r + j] * change[j];
      if (this.gravity) for (let j = 0; j < 3; j++) sum += out[r * r + r + 3 * i + j] * gravity[j];
      next[i] = sum;
    }
    for (let i = 0; i < r; i++) {
      change[i] = next[i];
      xhat[i] += next[i];
    }
  }
}

/** A run: every latent vector since t = 0, under the forcing of the moment. */
export class Run {
  /**
   * @param {Operators} operators
   * @param {{ xhat: number[], change: number[] }} start x̂_0 and what stands for d at t = 0
   * @param {number} dt [s]
   * @param {number} most steps that are kept
   */
  constructor(operators, start, dt, most) {
    this.operators = operators;
    this.start = start;
    this.dt = dt;
    this.most = most;
    /** @type {number[]} */ this.parameters = [];
    /** @type {Keyframes} */ this.program = { times: [0], values: [[0, 0, 0]] };
    /** @type {Solid[]} */ this.solids = [];
    /** @type {Float64Array[]} */ this.latents = [];
    /** @type {number[][]} gravity of each step */ this.gravities = [];
    /** @type {number[][]} parameters of each step */ this.given = [];
    /** @type {(number[] | null)[]} gravity of a hand in each step */ this.hands = [];
    /** @type {number[] | null} gravity of a hand from now on */ this.hand = null;
    this.change = new Float64Array(operators.latents);
    this.diverged = false;
    this.restart();
  }

  /** Number of steps taken. */
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
    this.latents = [Float64Array.from(this.start.xhat)];
    this.change = Float64Array.from(this.start.change);
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
   * Go on from an earlier step; what came after it is forgotten.
   * @param {number} step
   */
  rewind(step) {
    if (step >= this.steps) return;
    this.latents.length = step + 1;
    this.gravities.length = this.given.length = step;
    this.hands.length = Math.min(this.hands.length, step);
    const [now, before] = [this.latents[step], this.latents[Math.max(0, step - 1)]];
    this.change = step ? now.map((value, i) => value - before[i]) : Float64Array.from(this.start.change);
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
   * Take steps, at most as many as are kept; fewer where the latent vector ceases to be finite.
   * @param {number} count
   */
  advance(count) {
    for (const end = Math.min(this.steps + count, this.most); this.steps < end && !this.diverged; ) {
      const n = this.steps, xhat = this.latents[n].slice(), gravity = this.gravityAt(n);
      this.operators.step(xhat, this.change, this.parameters, gravity, stateOf(this.solids, n, this.dt));
      if (!xhat.every(Number.isFinite)) {
        this.diverged = true;
        return;
      }
      if (n >= this.hands.length) this.hands.push(this.hand);
      this.latents.push(xhat);
      this.gravities.push(gravity);
      this.given.push(this.parameters);
    }
  }
}
