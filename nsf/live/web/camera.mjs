// A camera that goes round a scene, z up, by pointer, touch, wheel and keys.

const AZIMUTH = -1.08; // [rad] at first
const GAP = 1.1; // from a body to the one beside it, over the width of the scene
const FILLED = [0.92, 0.84]; // of the picture's width and height, by the scene
const TURN = 0.008; // [rad] a pixel
const KEY_TURN = 0.1; // [rad] a key
const dot = (/** @type {number[]} */ a, /** @type {number[]} */ b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** Where the scene is seen from. */
export class Camera {
  /**
   * @param {number[]} lower corner of the scene [m]
   * @param {number[]} upper corner of the scene [m]
   * @param {() => void} changed called when it has moved
   */
  constructor(lower, upper, changed) {
    this.lower = lower;
    this.upper = upper;
    this.size = Math.hypot(...upper.map((v, c) => v - lower[c])) || 1;
    this.changed = changed;
    this.zoom = 1.9;
    this.azimuth = this.elevation = this.distance = 0;
    this.fits = true; // until someone comes nearer, or moves aside
    this.centre = [0, 0, 0];
    this.reset();
  }

  /** Look at the whole scene. */
  reset() {
    this.azimuth = AZIMUTH;
    this.elevation = 0.3;
    this.distance = 1.05 * this.size; // until it is drawn
    this.fits = true;
    this.centre = this.lower.map((v, c) => 0.5 * (v + this.upper[c]));
    this.changed();
  }

  /** Where a second body stands, to the right as it is looked at first, so that both are as far away [3] [m]. */
  beside() {
    const right = [-Math.sin(AZIMUTH), Math.cos(AZIMUTH), 0];
    const wide = right.reduce((sum, v, c) => sum + Math.abs(v) * (this.upper[c] - this.lower[c]), 0);
    return right.map((v) => GAP * wide * v);
  }

  /** Unit vectors to the right, up and toward the viewer. */
  get axes() {
    const { azimuth: a, elevation: e } = this;
    const toward = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const right = [-Math.sin(a), Math.cos(a), 0];
    const up = [
      toward[1] * right[2] - toward[2] * right[1],
      toward[2] * right[0] - toward[0] * right[2],
      toward[0] * right[1] - toward[1] * right[0],
    ];
    return { right, up, toward };
  }

  /**
   * World to clip space [16], by columns.
   * @param {number} aspect width over height
   */
  view(aspect) {
    const { right, up, toward } = this.axes;
    if (this.fits) this.distance = this._fitting(aspect);
    const eye = this.centre.map((c, k) => c + this.distance * toward[k]);
    const near = 0.02 * this.size, far = this.distance + 8 * this.size;
    const f = this.zoom * Math.min(1, aspect), depth = (far + near) / (near - far);
    const axes = [[right, f / aspect], [up, f], [toward, depth], [toward, -1]];
    const rows = axes.map(([axis, s]) => {
      const along = /** @type {number[]} */ (axis), by = /** @type {number} */ (s);
      return [...along.map((v) => by * v), -by * dot(along, eye)];
    });
    rows[2][3] += (2 * far * near) / (near - far);
    return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
  }

  /** Distance [m] at which the whole scene fills the picture. @param {number} aspect width over height */
  _fitting(aspect) {
    const { right, up, toward } = this.axes, f = this.zoom * Math.min(1, aspect);
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => this.centre.map((v, c) => ((k >> c) & 1 ? this.upper : this.lower)[c] - v));
    return Math.max(0.2 * this.size, ...corners.map((at) => dot(toward, at)
      + f * Math.max(Math.abs(dot(right, at)) / (aspect * FILLED[0]), Math.abs(dot(up, at)) / FILLED[1])));
  }

  /**
   * Pixels that a metre takes at unit depth, for a canvas of so many pixels.
   * @param {number} wide
   * @param {number} tall
   */
  pixels(wide, tall) {
    return 0.5 * this.zoom * Math.min(1, wide / tall) * tall;
  }

  /**
   * @param {number} azimuth [rad]
   * @param {number} elevation [rad]
   */
  turn(azimuth, elevation) {
    this.azimuth += azimuth;
    this.elevation = Math.max(-0.2, Math.min(1.5, this.elevation + elevation));
    this.changed();
  }

  /** @param {number} factor of the distance */
  approach(factor) {
    this.fits = false;
    this.distance = Math.max(0.2 * this.size, Math.min(8 * this.size, this.distance * factor));
    this.changed();
  }

  /**
   * @param {number} dx [pixel]
   * @param {number} dy [pixel]
   * @param {number} tall of the canvas [pixel]
   */
  move(dx, dy, tall) {
    const { right, up } = this.axes, metres = this.distance / tall;
    this.fits = false;
    this.centre = this.centre.map((c, k) => c - metres * (dx * right[k] - dy * up[k]));
    this.changed();
  }

  /**
   * Follow a canvas's pointers, wheel and keys.
   * @param {HTMLCanvasElement} canvas
   * @param {(dx: number, dy: number) => boolean} [taken] a drag that is not the camera's
   */
  follow(canvas, taken = () => false) {
    /** @type {Map<number, PointerEvent>} */
    const held = new Map();
    canvas.onpointerdown = (event) => {
      held.set(event.pointerId, event);
      canvas.setPointerCapture(event.pointerId);
    };
    canvas.onpointerup = canvas.onpointercancel = (event) => held.delete(event.pointerId);
    canvas.onpointermove = (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
      held.set(event.pointerId, event);
      if (held.size > 1) {
        const other = [...held.values()].find((own) => own.pointerId !== event.pointerId) ?? event;
        const apart = (/** @type {PointerEvent} */ e) => Math.hypot(e.clientX - other.clientX, e.clientY - other.clientY);
        this.approach(apart(before) / Math.max(1, apart(event)));
      } else if (event.shiftKey || event.buttons === 2) {
        this.move(dx, dy, canvas.clientHeight);
      } else if (!taken(dx, dy)) {
        this.turn(-TURN * dx, TURN * dy);
      }
    };
    canvas.oncontextmenu = (event) => event.preventDefault();
    canvas.ondblclick = () => this.reset();
    const wheel = (/** @type {WheelEvent} */ event) => {
      event.preventDefault();
      this.approach(Math.exp(0.001 * event.deltaY));
    };
    canvas.addEventListener("wheel", wheel, { passive: false });
    canvas.tabIndex = 0;
    /** @type {Record<string, () => void>} */
    const keys = {
      ArrowLeft: () => this.turn(KEY_TURN, 0),
      ArrowRight: () => this.turn(-KEY_TURN, 0),
      ArrowUp: () => this.turn(0, KEY_TURN),
      ArrowDown: () => this.turn(0, -KEY_TURN),
      "+": () => this.approach(0.9),
      "-": () => this.approach(1 / 0.9),
      Home: () => this.reset(),
    };
    canvas.onkeydown = (event) => {
      if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      event.stopPropagation();
      keys[event.key]();
    };
  }
}
