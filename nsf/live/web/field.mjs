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
   * Values [n, c] at all points, or at some, which the next call overwrites.
   * @param {Vector} xhat [r]
   * @param {Vector} parameters [n]
   * @param {Uint32Array | null} rows of the points
   * @param {number} components c of a point
   */
  at(xhat, parameters, rows = null, components = 1) {
    return this.of(this.coefficientsAt(xhat, parameters), rows, components);
  }

  /**
   * The same of coefficients of the first modes.
   * @param {Vector} coefficients
   * @param {Uint32Array | null} rows of the points
   * @param {number} components c of a point
   */
  of(coefficients, rows, components) {
    const { scaled, scale } = this;
    for (let k = 0; k < scaled.length; k++) scaled[k] = (coefficients[k] ?? 0) * scale[k];
    return combined(this.mean, this.modes, scaled, this.values, rows, components);
  }
}

/**
 * mean + modes · a.
 * @param {Numbers} mean [n, c]
 * @param {Numbers} modes [n, c, K]
 * @param {Float64Array} a [K]
 * @param {Float32Array} found [n, c]
 * @param {Uint32Array | null} rows of n; all by default
 * @param {number} components c
 */
function combined(mean, modes, a, found, rows, components) {
  const K = a.length, count = rows ? rows.length : mean.length / components;
  for (let q = 0, to = 0; q < count; q++) {
    let i = components * (rows ? rows[q] : q), m = i * K;
    for (let c = 0; c < components; c++, i++) {
      let sum = mean[i], other = 0, k = 0;
      for (; k < K - 1; k += 2, m += 2) {
        sum += modes[m] * a[k];
        other += modes[m + 1] * a[k + 1];
      }
      if (k < K) sum += modes[m++] * a[k];
      found[to++] = sum + other;
    }
  }
  return found;
}

/**
 * Von Mises equivalent [n] of stress [n, 6] in the order xx xy xz yy yz zz, over the end of its scale.
 * @param {Float32Array} tau [Pa]
 * @param {number} top [Pa]
 * @param {number} count n
 */
export function vonMises(tau, top, count) {
  const found = new Float32Array(count);
  for (let p = 0, i = 0; p < count; p++, i += 6) {
    const xx = tau[i], yy = tau[i + 3], zz = tau[i + 5];
    const shear = tau[i + 1] ** 2 + tau[i + 2] ** 2 + tau[i + 4] ** 2;
    found[p] = Math.sqrt(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * shear) / top;
  }
  return found;
}

/**
 * Displacement of some points of [n, 3], over the end of its scale.
 * @param {Numbers} x [m]
 * @param {Numbers} rest [m]
 * @param {number} top [m]
 * @param {Uint32Array} rows of the points
 */
export function displacement(x, rest, top, rows) {
  return Float32Array.from(rows, (p) => Math.hypot(x[3 * p] - rest[3 * p], x[3 * p + 1] - rest[3 * p + 1], x[3 * p + 2] - rest[3 * p + 2]) / top);
}
