// Fields of linear modes and their small networks, as `BasisManifold` of nsf.kinematics has them.

/** @typedef {import("./data.mjs").Packed} Packed */
/** @typedef {import("./data.mjs").Numbers} Numbers */
/** @typedef {ArrayLike<number>} Vector */

/** Linear layers with SiLU between them. */
export class Network {
  /**
   * @param {Packed} packed
   * @param {string} name of its arrays
   * @param {number} layers how many
   */
  constructor({ arrays }, name, layers) {
    // All in one kind of array, which a browser's compiler takes for granted; the rest is a tenth as fast.
    const held = (/** @type {Numbers} */ values) => Float64Array.from(values);
    this.layers = Array.from({ length: layers }, (_, k) => {
      const [weight, bias] = [held(arrays[`${name}.weight${k}`]), held(arrays[`${name}.bias${k}`])];
      return { weight, bias, outputs: new Float64Array(bias.length) };
    });
    const { weight, bias } = this.layers[0];
    /** What `outputs` reads. */
    this.inputs = new Float64Array(weight.length / bias.length);
  }

  /**
   * Its outputs at `inputs`, which the next call overwrites.
   * @returns {Float64Array}
   */
  outputs() {
    const { layers } = this;
    let values = this.inputs;
    for (let k = 0; k < layers.length; k++) {
      layer(layers[k].weight, layers[k].bias, values, layers[k].outputs, k < layers.length - 1);
      values = layers[k].outputs;
    }
    return values;
  }
}

/**
 * One layer.
 * @param {Float64Array} weight [out, in]
 * @param {Float64Array} bias [out]
 * @param {Float64Array} values [in]
 * @param {Float64Array} outputs [out]
 * @param {boolean} inner whether SiLU follows
 */
function layer(weight, bias, values, outputs, inner) {
  const n = values.length;
  for (let row = 0, w = 0; row < outputs.length; row++) {
    // Two sums, since an addition waits for the one before it.
    let sum = bias[row], other = 0, i = 0;
    for (; i < n - 1; i += 2, w += 2) {
      sum += weight[w] * values[i];
      other += weight[w + 1] * values[i + 1];
    }
    if (i < n) sum += weight[w++] * values[i];
    sum += other;
    outputs[row] = inner ? sum / (1 + Math.exp(-sum)) : sum;
  }
}

/** mean + Σ_k scale_k modes_k a_k at points, a = [the first inputs ; network(inputs)]. */
export class Field {
  /**
   * @param {Packed} packed
   * @param {string} name
   */
  constructor(packed, name) {
    const { arrays, header } = packed, told = header.fields[name];
    this.mean = arrays[`${name}.mean`];
    this.modes = arrays[`${name}.modes`];
    this.scale = arrays[`${name}.scale`];
    /** @type {number} */ this.leading = told.leading;
    /** @type {boolean} */ this.takesParameters = told.parameters;
    this.network = told.layers ? new Network(packed, name, told.layers) : null;
    this.coefficients = new Float64Array(this.scale.length);
    this.scaled = new Float64Array(this.scale.length);
    this.values = new Float32Array(this.mean.length);
  }

  /**
   * a [K], in units without the scale of the modes.
   * @param {Vector} xhat [r]
   * @param {Vector} parameters [n]
   */
  coefficientsAt(xhat, parameters) {
    const a = this.coefficients, { leading, network } = this;
    for (let k = 0; k < leading; k++) a[k] = xhat[k];
    if (network) {
      network.inputs.set(xhat);
      if (this.takesParameters) network.inputs.set(parameters, xhat.length);
      const found = network.outputs();
      // Modes of least energy may have been left out.
      for (let k = leading; k < a.length; k++) a[k] = found[k - leading];
    }
    return a;
  }

  /**
   * Values [n, c], which the next call overwrites.
   * @param {Vector} xhat [r]
   * @param {Vector} parameters [n]
   */
  at(xhat, parameters) {
    const a = this.coefficientsAt(xhat, parameters), { scaled, scale } = this;
    for (let k = 0; k < a.length; k++) scaled[k] = a[k] * scale[k];
    return combined(this.mean, this.modes, scaled, this.values);
  }
}

/**
 * mean + modes · a.
 * @param {Numbers} mean [n]
 * @param {Numbers} modes [n, K]
 * @param {Float64Array} a [K]
 * @param {Float32Array} found [n]
 */
function combined(mean, modes, a, found) {
  const K = a.length;
  for (let i = 0, m = 0; i < found.length; i++) {
    let sum = mean[i], other = 0, k = 0;
    for (; k < K - 1; k += 2, m += 2) {
      sum += modes[m] * a[k];
      other += modes[m + 1] * a[k + 1];
    }
    if (k < K) sum += modes[m++] * a[k];
    found[i] = sum + other;
  }
  return found;
}

/**
 * Von Mises equivalent [n] of stress [n, 6] in the order xx xy xz yy yz zz, over the end of its scale.
 * @param {Float32Array} tau [Pa]
 * @param {number} top [Pa]
 * @param {Float32Array} found
 */
export function vonMises(tau, top, found) {
  for (let p = 0, i = 0; p < found.length; p++, i += 6) {
    const xx = tau[i], yy = tau[i + 3], zz = tau[i + 5];
    const shear = tau[i + 1] ** 2 + tau[i + 2] ** 2 + tau[i + 4] ** 2;
    found[p] = Math.sqrt(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * shear) / top;
  }
  return found;
}

/**
 * Displacement [n] of points [n, 3], over the end of its scale.
 * @param {Float32Array} x [m]
 * @param {Numbers} rest [m]
 * @param {number} top [m]
 * @param {Float32Array} found
 */
export function displacement(x, rest, top, found) {
  for (let p = 0, i = 0; p < found.length; p++, i += 3)
    found[p] = Math.hypot(x[i] - rest[i], x[i + 1] - rest[i + 1], x[i + 2] - rest[i + 2]) / top;
  return found;
}
