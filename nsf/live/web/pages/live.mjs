// A model that runs in the page: closure, operators and modes are in the file, and a hand steers it.

import { Camera } from "../camera.mjs";
import { button, choice, counted, download, element, fail, find, headed, keyed, legend, lit, onLook, slider, tick } from "../controls.mjs";
import { Recording, inflated, unpacked } from "../data.mjs";
import { Drawing, Pace } from "../drawing.mjs";
import { Field, displacement, vonMises } from "../field.mjs";
import { Operators, Run } from "../operators.mjs";
import { along, moved } from "../solids.mjs";
import { Tilt } from "../tilt.mjs";
import { Trust } from "../trust.mjs";

const HOLD = 0.7; // [s] for which the end stands before the run begins again
const MOST = 50000; // steps that a run of a hand may take
const LOOKS = 24; // moments of a run made anew at which it is looked at
const SPEEDS = [0.0625, 0.125, 0.25, 0.5, 1, 2, 4];
const SHOWN_IN = 4; // [s] about, in which a run is shown at first

/** The model of a page and what is shown of it. */
export class Live {
  /** @param {import("../data.mjs").Packed} packed */
  constructor(packed) {
    const { header: told, arrays } = packed;
    this.told = told;
    this.rest = arrays.rest;
    this.deformation = new Field(packed, "deformation");
    this.stress = told.fields.stress ? new Field(packed, "stress") : null;
    this.trust = new Trust(packed, this.deformation);
    /** @type {Map<string, Recording>} */
    this.recordings = new Map(Object.keys(told.recordings).map((name) => [name, new Recording(packed, name)]));
    this.run = new Run(new Operators(packed), told.start, told.dt, MOST);
    this.cursor = 0; // of steps, with its fraction
    /** @type {number[]} distance from the training runs in the steps that were looked at */ this.tube = [];
    /** @type {number[]} largest distance of gravity up to each step */ this.gravity = [];
    this.case = told.cases[0];
    this.take(0);
  }

  /** The last step: that of the scene, or without end once a hand has tilted the run. */
  get end() {
    return this.byHand ? MOST : this.told.steps;
  }

  /** Whether a hand has tilted gravity or moved a solid. */
  get byHand() {
    const { run } = this;
    return run.hand !== null || run.hands.some(Boolean) || run.solids !== this.case.solids;
  }

  /** The step that is shown. */
  get step() {
    return Math.min(Math.floor(this.cursor + 1e-9), this.run.steps);
  }

  /**
   * Take up a held-out case: its parameters, and its program where it has one.
   * @param {number} index
   */
  take(index) {
    this.case = this.told.cases[index];
    this.run.program = this.case.gravity;
    this.run.solids = this.case.solids;
    this.run.parameters = this.case.values;
    this.run.hand = null;
    this.run.hands = [];
    this.anew();
  }

  /** Make the run anew up to the moment that is shown. */
  anew() {
    const step = this.step;
    this.run.again(Math.ceil(this.cursor - 1e-9));
    this.tube = [];
    this.gravity = [];
    this.cursor = Math.min(this.cursor, this.run.steps);
    for (let k = 1; k < LOOKS; k++) this._look(Math.floor((k * step) / LOOKS));
  }

  /**
   * Other parameters.
   * @param {number[]} values
   * @param {boolean} fromHere whether the run goes on from the moment that is shown
   */
  steer(values, fromHere) {
    if (fromHere) this._forget();
    this.run.parameters = values;
    if (!fromHere) this.anew();
  }

  /**
   * Gravity of a hand from the moment that is shown; null gives it back to the scene.
   * @param {number[] | null} gravity [m/s²]
   */
  tilt(gravity) {
    this._forget();
    this.run.hand = gravity;
  }

  /**
   * Move a solid from the moment that is shown on.
   * @param {number} index
   * @param {number} place along its direction [m]
   */
  move(index, place) {
    this._forget();
    const t = this.step * this.told.dt;
    this.run.solids = this.run.solids.map((own, i) => (i === index ? moved(own, t, place) : own));
  }

  /** Go back to t = 0, without a hand. */
  reset() {
    this.cursor = 0;
    this.run.solids = this.case.solids;
    this.run.hands = [];
    this.run.hand = null;
    this.anew();
  }

  /**
   * Show a moment.
   * @param {number} cursor steps since t = 0, with their fraction
   */
  seek(cursor) {
    this.cursor = Math.max(0, Math.min(cursor, this.end));
    this.run.advance(Math.ceil(this.cursor) - this.run.steps);
    this.cursor = Math.min(this.cursor, this.run.steps);
  }

  /** x̂ that is shown. */
  get xhat() {
    const { latents, steps } = this.run, n = this.step, part = this.cursor - n;
    const here = latents[n];
    return part > 0 && n < steps ? here.map((value, i) => value + part * (latents[n + 1][i] - value)) : here;
  }

  /** Parameters in the step that is shown. */
  get parameters() {
    return this.run.given[this.step] ?? this.run.parameters;
  }

  /** Whether the run that is shown is that of the case that was taken up. */
  get held() {
    const same = this.parameters.every((value, i) => value === this.case.values[i]);
    return same && !this.byHand;
  }

  /** The light, for all steps up to the one that is shown. */
  light() {
    const n = this.step, { run } = this;
    this._look(n);
    for (let k = this.gravity.length; k < n; k++)
      this.gravity.push(Math.max(this.gravity[k - 1] ?? 0, this.trust.ofGravity(run.gravities[k])));
    let tube = 0;
    for (let k = 0; k <= n; k++) tube = Math.max(tube, this.tube[k] ?? 0);
    const diverged = run.diverged && n === run.steps ? n * run.dt : null;
    const estimate = this.held ? this.case.estimate : null;
    return this.trust.light(this.parameters, tube, n ? this.gravity[n - 1] : 0, diverged, estimate);
  }

  /** The latent trajectory, as a table. */
  table() {
    const { run, told } = this, names = told.parameters.map((/** @type {{ name: string }} */ p) => p.name);
    const heads = ["t [s]", ...run.start.xhat.map((_, i) => `xhat_${i}`), "g_x [m/s2]", "g_y [m/s2]", "g_z [m/s2]", ...names];
    const cell = (/** @type {number | string} */ v) => (typeof v === "number" ? String(v) : `"${v.replaceAll('"', '""')}"`);
    const rows = run.latents.map((xhat, n) => {
      const k = Math.min(n, run.steps - 1), none = [run.gravityAt(n), run.parameters];
      return [n * run.dt, ...xhat, ...(run.gravities[k] ?? none[0]), ...(run.given[k] ?? none[1])];
    });
    return [heads, ...rows].map((row) => row.map(cell).join(",")).join("\n") + "\n";
  }

  _forget() {
    this.cursor = this.step;
    this.run.rewind(this.step);
    this.tube.length = Math.min(this.tube.length, this.step + 1);
    this.gravity.length = Math.min(this.gravity.length, this.step);
  }

  /** @param {number} n */
  _look(n) {
    if (n > 0) this.tube[n] ??= this.trust.ofLatent(this.run.latents[n]);
  }
}

/** Show the model that the page holds. */
async function show() {
  const data = find("data"), live = new Live(unpacked(await inflated(data.textContent))), { told } = live;
  data.remove();
  const state = { playing: true, changed: true, color: live.stress ? "von_mises" : "displacement", drawn: 0, seconds: 0 };
  const change = () => { state.changed = true; };
  const first = told.dt * told.steps / SHOWN_IN;
  const speed = SPEEDS.reduce((best, own) => (Math.abs(Math.log(own / first)) < Math.abs(Math.log(best / first)) ? own : best));
  headed(told.title, `a reduced model that runs in this page: ${counted(told.points, told.particles)}, ${told.latents} latent coordinates, ${told.run}`);

  const camera = new Camera(told.lower, told.upper, change), drawing = new Drawing(find("canvas"), camera, told);
  const body = drawing.body(live.rest);
  // To the right as the camera looks at first, so that both are as far from it.
  const { right } = camera.axes, wide = right.reduce((sum, v, c) => sum + Math.abs(v) * (told.upper[c] - told.lower[c]), 0);
  const beside = right.map((v) => 1.1 * wide * v);
  const truths = new Map([...live.recordings].map(([name, own]) => [name, drawing.body(own.rest, beside, told.radius * Math.cbrt(told.points / own.points))]));

  const frame = element("input", { id: "frame", type: "range", min: 0, max: told.steps, value: 0, step: 1, ariaLabel: "step" });
  const time = element("output", { id: "time" }), note = element("small", { id: "note" }), sides = element("small");
  const set = (/** @type {boolean} */ on) => {
    state.playing = on;
    if (on && live.cursor >= live.end) live.seek(0);
    find("play").textContent = on ? "Pause" : "Play";
  };
  const seek = (/** @type {number} */ to) => {
    set(false);
    live.seek(to);
    change();
  };
  const paint = (/** @type {string} */ color) => {
    state.color = color;
    legend(told.quantities[color], told.colors);
    change();
  };
  const reset = () => {
    live.reset();
    tilt?.upright();
    change();
  };
  frame.oninput = () => seek(Number(frame.value));
  /** @type {any[]} */
  const sliders = told.parameters.map((/** @type {import("../controls.mjs").Parameter} */ p, /** @type {number} */ i) =>
    slider(p, live.case.values[i], () => {
      live.steer(sliders.map((own) => Number(own.input.value)), find("from").value === "here");
      change();
    }),
  );
  const tilt = told.gravity ? new Tilt(told.gravity, () => camera.axes, (gravity) => {
    live.tilt(gravity);
    if (gravity) set(true);
    change();
  }) : null;
  /** @type {{ index: number, own: any }[]} */
  const handles = live.case.solids.flatMap((/** @type {import("../solids.mjs").Solid} */ solid, /** @type {number} */ index) => {
    if (!solid.movable) return [];
    const { low, high } = solid.movable, step = (high - low) / 200;
    const p = { name: `place of ${solid.name}`, unit: "m", lower: low, upper: high, step, trained: [low, high] };
    return [{ index, own: slider(p, 0, (place) => {
      live.move(index, place);
      set(true);
      change();
    }) }];
  });
  const cases = told.cases.map((/** @type {{ label: string }} */ own, /** @type {number} */ i) => [String(i), own.label]);
  const take = (/** @type {string} */ index) => {
    live.take(Number(index));
    tilt?.upright();
    sliders.forEach((own, i) => own.show(live.case.values[i]));
    change();
  };
  const truth = tick("truth", "full-order run beside it", (on) => {
    camera.upper = on ? told.upper.map((/** @type {number} */ v, /** @type {number} */ c) => v + beside[c]) : told.upper;
    camera.size = Math.hypot(...camera.upper.map((v, c) => v - camera.lower[c]));
    camera.reset();
  });
  const colors = Object.entries(told.quantities).map(([name, { title }]) => /** @type {[string, string]} */ ([name, title]));
  const picture = () => {
    drawing.level = 0;
    render();
    find("canvas").toBlob((/** @type {Blob} */ png) => download(`${told.file}.png`, png));
  };
  const keep = () => download(`${told.file}.csv`, new Blob([live.table()], { type: "text/csv" }));
  find("panel").append(
    element("div", { className: "bar" },
      button("play", "Pause", () => set(!state.playing), "space"),
      button("step", "Step", () => seek(live.step + 1), "right arrow"),
      button("reset", "Reset", reset, "R"),
      frame),
    element("div", { className: "row" }, time, choice("speed", "speed", SPEEDS.map((v) => [String(v), `${v} ×`]), String(speed), () => {})),
    ...sliders.map((own) => own.made),
    choice("from", "moved sliders act", [["start", "from t = 0"], ["here", "from now on"]], "start", () => {}),
    ...(tilt ? [tilt.made] : []),
    ...handles.map(({ own }) => own.made),
    choice("case", "held-out case", cases, "0", take),
    ...(live.recordings.size ? [element("div", {}, truth, sides)] : []),
    element("div", { id: "light", role: "status" }),
    choice("color", "colour", colors, state.color, paint),
    tick("cut", "cut open", (on) => {
      drawing.cut = on;
      change();
    }),
    element("div", { className: "bar" }, button("picture", "Keep picture", picture), button("table", "Keep latent trajectory", keep)),
    note,
  );

  const render = () => {
    const { xhat, parameters, stress } = live, top = told.quantities[state.color].top, byStress = state.color === "von_mises" && stress;
    const x = live.deformation.at(xhat, parameters);
    body.show(x, (rows) => byStress ? vonMises(byStress.at(xhat, parameters, rows, 6), top, rows.length) : displacement(x, live.rest, top, rows));
    const wanted = find("case") && live.held && live.recordings.size && find("truth").checked ? live.case.recording : null;
    for (const [name, own] of truths) {
      own.visible = name === wanted;
      const run = live.recordings.get(name);
      if (!own.visible || !run) continue;
      const found = run.at(run.frameAt(live.cursor * told.dt));
      own.show(found.x, (rows) => byStress ? found.stressOf(rows) : displacement(found.x, run.rest, top, rows));
    }
    drawing.solids = live.run.solids;
    drawing.time = live.cursor * told.dt;
    drawing.draw();
  };
  const tell = () => {
    time.textContent = `t = ${(live.cursor * told.dt).toFixed(3)} s`;
    frame.max = Math.max(told.steps, live.end === MOST ? live.run.steps : 0);
    frame.value = live.step;
    for (const { index, own } of handles)
      if (!own.input.matches(":active, :focus-visible")) own.show(along(live.run.solids[index], live.cursor * told.dt));
    lit(live.light());
    const estimate = live.held && live.case.estimate !== null
      ? ` Estimated distance from the projected run, at most ${(1000 * live.case.estimate).toPrecision(2)} mm.` : "";
    const stored = live.held && live.case.recording ? "Left: the reduced run; right: the full-order one." : "No full-order run of this was stored.";
    sides.textContent = live.recordings.size && find("truth").checked ? stored : "";
    note.textContent = `Steps of ${told.dt} s by operators.${estimate}`;
    document.body.dataset.step = String(live.step);
  };
  const pace = new Pace(drawing);
  let last = performance.now(), beyond = 0;
  const next = (/** @type {number} */ now) => {
    const passed = Math.max(0, Math.min(0.2, (now - last) / 1000));
    last = now;
    if (state.playing) {
      const to = live.cursor + (passed * Number(find("speed").value)) / told.dt;
      beyond = to > live.end || live.run.diverged ? beyond + passed : 0;
      if (!beyond || live.cursor < live.end) {
        live.seek(to);
        change();
      }
      if (beyond > HOLD && !live.run.diverged) {
        live.seek(0);
        change();
      }
    }
    if (pace.draws(now, state.changed)) {
      state.changed = false;
      const began = performance.now();
      render();
      tell();
      state.seconds = (performance.now() - began) / 1000;
      state.drawn++;
    }
    requestAnimationFrame(next);
  };
  camera.follow(find("canvas"), (dx, dy) => tilt?.drag(dx, dy) ?? false);
  onLook(change);
  keyed({ " ": () => set(!state.playing), ArrowRight: () => seek(live.step + 1), ArrowLeft: () => seek(live.step - 1), r: reset });
  paint(state.color);
  requestAnimationFrame(next);
  Object.assign(window, { nsf: { live, state, camera, drawing } });
  document.body.dataset.ready = "true";
}

if (globalThis.document) show().catch(fail);
