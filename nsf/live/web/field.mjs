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
    this.layers = Array.from({ length: layers }, (_, k) => {
      const [weight, bias] = [arrays[`${name}.weight${k}`], arrays[`${name}.bias${k}`]];
      return { weight, bias, outputs: new Float64Array(bias.length) };
    });
  }

  /**
   * Its outputs, which the next call overwrites.
   * @param {Vector} inputs
   * @returns {Float64Array}
   */
  outputs(inputs) {
    /** @type {any} */
    let values = inputs;
    this.layers.forEach(({ weight, bias, outputs }, layer) => {
      const n = values.length, inner = layer < this.layers.length - 1;
      for (let row = 0, w = 0; row < outputs.length; row++) {
        let sum = bias[row];
        for (let i = 0; i < n; i++) sum += weight[w++] * values[i];
        outputs[row] = inner ? sum / (1 + Math.exp(-sum)) : sum;
      }
      values = outputs;
    });
    return values;
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
      const found = network.outputs(this.takesParameters ? [...Array.from(xhat), ...Array.from(parameters)] : xhat);
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
    const a = this.coefficientsAt(xhat, parameters), { scaled, scale, values, mean, modes } = this, K = a.length;
    for (let k = 0; k < K; k++) scaled[k] = a[k] * scale[k];
    for (let i = 0, m = 0; i < values.length; i++) {
      let sum = mean[i];
      for (let k = 0; k < K; k++) sum += modes[m++] * scaled[k];
      values[i] = sum;
    }
    return values;
  }
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
