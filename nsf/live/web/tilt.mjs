// Gravity by hand: a pad that is dragged or moved by keys, a drag on the picture, or the device's own tilt.

import { button, element, tick } from "./controls.mjs";

const REACH = 1.5; // of the pad, over the largest tilt that was taught
const STEP = 0.1; // of the pad a key
const PIXELS = 160; // of a drag on the picture that go from the middle of the pad to its rim

/**
 * Gravity turned by an angle, in a direction as the viewer sees it.
 * @param {number[]} down gravity of the scene [3] [m/s²]
 * @param {{ right: number[], toward: number[] }} axes of the camera
 * @param {number} right angle [rad] to the viewer's right
 * @param {number} ahead angle [rad] away from the viewer
 */
export function tilted(down, axes, right, ahead) {
  const size = Math.hypot(...down), unit = down.map((v) => v / size), angle = Math.hypot(right, ahead);
  if (angle < 1e-9) return down.slice();
  // The picture's own directions, as they lie across gravity.
  const across = [axes.right, axes.toward.map((v) => -v)].map((axis) => {
    const along = axis.reduce((sum, v, c) => sum + v * unit[c], 0), flat = axis.map((v, c) => v - along * unit[c]);
    const length = Math.hypot(...flat) || 1;
    return flat.map((v) => v / length);
  });
  const aside = unit.map((_, c) => (right * across[0][c] + ahead * across[1][c]) / angle);
  return unit.map((v, c) => size * (Math.cos(angle) * v + Math.sin(angle) * aside[c]));
}

/** The pad and what stands beside it. */
export class Tilt {
  /**
   * @param {{ down: number[], angle: number }} told gravity of the scene [m/s²], and the largest tilt taught [rad]
   * @param {() => { right: number[], toward: number[] }} axes of the camera
   * @param {(gravity: number[] | null) => void} act
   */
  constructor({ down, angle }, axes, act) {
    this.down = down;
    this.axes = axes;
    this.act = act;
    this.rim = Math.min(REACH * angle, 0.5 * Math.PI); // [rad]
    this.x = this.y = 0; // over the radius of the pad: to the right, and up, which is away from the viewer
    this.dot = element("b");
    const taught = element("i"), share = (100 * angle) / this.rim;
    taught.style.width = taught.style.height = `${share}%`;
    this.pad = element("div", { id: "pad", tabIndex: 0, role: "group" }, taught, this.dot);
    this.pad.onpointerdown = (/** @type {PointerEvent} */ event) => {
      this.pad.setPointerCapture(event.pointerId);
      this._follow(event);
    };
    this.pad.onpointermove = (/** @type {PointerEvent} */ event) => {
      if (event.buttons) this._follow(event);
    };
    this.pad.onkeydown = (/** @type {KeyboardEvent} */ event) => {
      const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (!way) return;
      event.preventDefault();
      event.stopPropagation();
      this.to(this.x + STEP * way[0], this.y + STEP * way[1]);
    };
    this.byDrag = tick("drag", "a drag on the picture tilts", () => {});
    this.own = button("device", "Use this device's tilt", () => this._device());
    // A desktop has no tilt of its own.
    this.own.hidden = !("DeviceOrientationEvent" in window && matchMedia("(pointer: coarse)").matches);
    const back = button("upright", "Scene's own gravity", () => {
      this.upright();
      act(null);
    });
    const about = element("small", {}, "Gravity: drag the dot. Inside the dashed ring it was taught.");
    this.made = element("div", {}, about, element("div", { className: "tilt" }, this.pad, element("div", {}, back, this.byDrag, this.own)));
    this._say();
  }

  /** Put the dot into the middle. */
  upright() {
    this.x = this.y = 0;
    this._say();
  }

  /**
   * Tilt.
   * @param {number} x over the radius of the pad, to the right
   * @param {number} y likewise, away from the viewer
   */
  to(x, y) {
    const size = Math.max(1, Math.hypot(x, y));
    [this.x, this.y] = [x / size, y / size];
    this._say();
    this.act(tilted(this.down, this.axes(), this.rim * this.x, this.rim * this.y));
  }

  /**
   * A drag on the picture; true where it tilts.
   * @param {number} dx [pixel]
   * @param {number} dy [pixel]
   */
  drag(dx, dy) {
    if (!this.byDrag.firstChild.checked) return false;
    this.to(this.x + dx / PIXELS, this.y - dy / PIXELS);
    return true;
  }

  /** @param {PointerEvent} event */
  _follow(event) {
    const { left, top, width, height } = this.pad.getBoundingClientRect();
    this.to((2 * (event.clientX - left)) / width - 1, 1 - (2 * (event.clientY - top)) / height);
  }

  async _device() {
    const kind = /** @type {any} */ (DeviceOrientationEvent);
    const answer = await kind.requestPermission?.().catch(() => "denied");
    if (answer && answer !== "granted") {
      this.own.textContent = "This device keeps its tilt to itself";
      return;
    }
    /** @type {number[] | null} */
    let first = null;
    addEventListener("deviceorientation", ({ beta, gamma }) => {
      if (beta === null || gamma === null) return;
      first ??= [beta, gamma];
      const [ahead, right] = [first[0] - beta, gamma - first[1]].map((v) => (v * Math.PI) / 180 / this.rim);
      this.to(right, ahead);
    });
  }

  _say() {
    Object.assign(this.dot.style, { left: `${50 + 50 * this.x}%`, top: `${50 - 50 * this.y}%` });
    const degrees = [this.x, this.y].map((v) => Math.round((180 * this.rim * v) / Math.PI));
    this.pad.ariaLabel = `gravity, tilted by ${degrees[0]}° to the right and ${degrees[1]}° away; arrow keys tilt it`;
  }
}
