// The page of a run: recorded in the page, run by the page, or followed from a server.

import { Camera } from "./camera.mjs";
import { button, choice, element, fail, find, headed, keyed, legend, lit, onLook, tick } from "./controls.mjs";
import { inflated, unpacked } from "./data.mjs";
import { Drawing, Pace } from "./drawing.mjs";
import { LivePlayer } from "./live.mjs";
import { RecordedPlayer } from "./recorded.mjs";
import { StreamPlayer } from "./stream.mjs";

/** @typedef {import("./trust.mjs").Light} Light */
/**
 * What a page shows, and how it goes on. Its cursor counts frames or steps since t = 0, with their fraction.
 * @typedef {object} Player
 * @property {any} told the header of what the page holds or was sent
 * @property {string} about said below the title
 * @property {string} color of the quantities, by which it begins
 * @property {number} cursor
 * @property {number} end the last value of the cursor
 * @property {number} length of the slider of the cursor
 * @property {number} t [s]
 * @property {boolean} [remote] whether a server says what plays
 * @property {boolean} [stuck] whether it cannot go on
 * @property {number} pace by which the cursor goes on in a second
 * @property {[string, string][]} speeds factors of the pace that can be chosen; none where a server has the pace
 * @property {string} speed
 * @property {(cursor: number) => void} seek
 * @property {(on: boolean) => void} [play] asks a server to
 * @property {(color: string) => void} [paint] asks a server to
 * @property {(page: Page) => Node[]} [controls] of its own, between those of time and of the picture
 * @property {(drawing: Drawing) => void} place makes its bodies
 * @property {(color: string) => void} draw puts the moment into its bodies
 * @property {() => { light: Light, note: string }} [tell]
 * @property {() => void} [reset]
 * @property {(dx: number, dy: number) => boolean} [drag] whether a drag on the picture is not the camera's
 * @property {() => boolean} [fresh] whether a server has sent anything new
 */

const HOLD = 0.7; // [s] for which the end stands before the run begins again

/** The page: controls, camera and drawing about a player. */
export class Page {
  /** @param {Player} player */
  constructor(player) {
    const { told } = player;
    this.player = player;
    this.state = { playing: true, changed: true, color: player.color, drawn: 0, seconds: 0 };
    this.camera = new Camera(told.lower, told.upper, () => this.change());
    this.drawing = new Drawing(find("canvas"), this.camera, told);
    this.pace = new Pace(this.drawing);
    this.last = performance.now();
    this.beyond = 0; // [s] since the end was reached
    player.place(this.drawing);
    this._furnish();
  }

  /** Something is to be drawn. */
  change() {
    this.state.changed = true;
  }

  /** Play or pause. @param {boolean} on */
  set(on) {
    const { player, state } = this;
    player.play?.(on);
    if (player.remote) return;
    if (on && player.cursor >= player.end) player.seek(0);
    this.playing(on);
    state.changed = true;
  }

  /** Say whether it plays. @param {boolean} on */
  playing(on) {
    this.state.playing = on;
    find("play").textContent = on ? "Pause" : "Play";
  }

  /** Pause at a moment. @param {number} cursor */
  seek(cursor) {
    this.set(false);
    this.player.seek(Math.max(0, Math.min(this.player.end, cursor)));
    this.change();
  }

  /** Colour by a quantity. @param {string} color */
  paint(color) {
    const { told } = this.player, quantity = told.quantities[color];
    this.state.color = find("color").value = color;
    this.drawing.paint(quantity.colors ?? told.colors);
    legend(quantity, quantity.colors ?? told.colors);
    this.change();
  }

  /** Colour by a quantity that a user chooses, on a server for all who look. @param {string} color */
  choose(color) {
    this.paint(color);
    this.player.paint?.(color);
  }

  /** Go back to t = 0, without a hand. */
  reset() {
    this.player.reset?.();
    this.change();
  }

  /** Show another part of the scene. @param {number[]} upper corner [m] */
  reach(upper) {
    const { camera } = this;
    camera.upper = upper;
    camera.size = Math.hypot(...upper.map((v, c) => v - camera.lower[c]));
    camera.reset();
  }

  /** A frame of the browser. @param {number} now [ms] */
  next(now) {
    const { player, state } = this, passed = Math.max(0, Math.min(0.2, (now - this.last) / 1000));
    this.last = now;
    if (player.remote) state.changed ||= player.fresh?.() ?? false;
    else if (state.playing) this._goOn(passed);
    if (this.pace.draws(now, state.changed)) {
      state.changed = false;
      const began = performance.now();
      this.draw();
      state.seconds = (performance.now() - began) / 1000;
      state.drawn++;
    }
    requestAnimationFrame((then) => this.next(then));
  }

  /** Draw and say the moment. */
  draw() {
    const { player, drawing, state } = this;
    player.draw(state.color);
    drawing.time = player.t;
    drawing.draw();
    find("time").textContent = `t = ${player.t.toFixed(3)} s`;
    const slider = find("frame");
    slider.max = String(player.length);
    if (!slider.matches(":active")) slider.value = String(Math.round(player.cursor));
    const said = player.tell?.();
    find("light").hidden = !said;
    if (said) lit(said.light);
    find("note").textContent = said?.note ?? "";
    document.body.dataset.cursor = player.cursor.toFixed(2);
  }

  /** @param {number} passed [s] */
  _goOn(passed) {
    const { player } = this;
    const to = player.cursor + passed * player.pace * Number(find("speed").value);
    this.beyond = to > player.end || player.stuck ? this.beyond + passed : 0;
    if (!this.beyond || player.cursor < player.end) {
      player.seek(Math.min(to, player.end));
      this.change();
    }
    if (this.beyond > HOLD && !player.stuck) {
      player.seek(0);
      this.change();
    }
  }

  _furnish() {
    const { player, drawing } = this, { quantities, title } = player.told;
    headed(title, player.about);
    const step = (/** @type {number} */ by) => this.seek(Math.round(player.cursor) + by), toggle = () => this.set(!this.state.playing);
    const slider = { id: "frame", type: "range", min: 0, max: player.length, value: 0, step: 1, ariaLabel: "step" };
    const frame = element("input", { ...slider, oninput: () => this.seek(Number(frame.value)) });
    const colors = Object.entries(quantities).map(([name, own]) => /** @type {[string, string]} */ ([name, own.title]));
    const cut = tick("cut", "cut open", (on) => {
      drawing.cut = on;
      this.change();
    });
    find("panel").append(
      element("div", { className: "bar" },
        button("play", "Pause", toggle, "space"),
        button("step", "Step", () => step(1), "right arrow"),
        ...(player.reset ? [button("reset", "Reset", () => this.reset(), "R")] : []),
        frame),
      element("div", { className: "row" }, element("output", { id: "time" }),
        ...(player.speeds.length ? [choice("speed", "speed", player.speeds, player.speed, () => {})] : [])),
      element("div", { id: "light", role: "status" }),
      ...(player.controls?.(this) ?? []),
      choice("color", "colour", colors, player.color, (color) => this.choose(color)),
      cut,
      element("small", { id: "note" }),
    );
    onLook(() => this.change());
    keyed({ " ": toggle, ArrowLeft: () => step(-1), ArrowRight: () => step(1), r: () => this.reset() });
  }
}

/** Show what the page holds, or what its server sends. */
async function show() {
  const data = document.getElementById("data");
  const packed = data && unpacked(await inflated(data.textContent ?? ""));
  data?.remove();
  /** @type {Player} */
  const player = !packed ? await StreamPlayer.joined() : packed.header.recurrence ? new LivePlayer(packed) : new RecordedPlayer(packed);
  const page = new Page(player), asked = new URLSearchParams(location.hash.slice(1)), color = asked.get("color") ?? "";
  page.camera.follow(find("canvas"), (dx, dy) => player.drag?.(dx, dy) ?? false);
  page.paint(player.color);
  if (color in player.told.quantities) page.choose(color);
  if (asked.has("frame")) page.seek(Number(asked.get("frame")) || 0);
  requestAnimationFrame((now) => page.next(now));
  Object.assign(window, { nsf: { page, player, state: page.state, camera: page.camera, drawing: page.drawing } });
  document.body.dataset.ready = "true";
}

show().catch(fail);
