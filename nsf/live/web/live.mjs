// A model that runs in the page: closure, recurrence and modes are in the file, and a hand steers it.

import { button, choice, counted, download, element, find, slider, sliders, tick } from "./controls.mjs";
import { Recording } from "./data.mjs";
import { Field, displacement, vonMises } from "./field.mjs";
import { Recurrence, Run } from "./recurrence.mjs";
import { along, moved } from "./solids.mjs";
import { Surface } from "./surface.mjs";
import { Tilt } from "./tilt.mjs";
import { Trust } from "./trust.mjs";

const MOST = 50000; // steps that a run of a hand may take
const SPEEDS = [0.0625, 0.125, 0.25, 0.5, 1, 2, 4];
const SHOWN_IN = 4; // [s] about, in which a run is shown at first

/** The model of a page and what is shown of it. */
export class Live {
  /** @param {import("./data.mjs").Packed} packed */
  constructor(packed) {
    const { header: told, arrays } = packed;
    this.told = told;
    this.arrays = arrays;
    this.rest = arrays.rest;
    this.deformation = new Field(packed, "deformation");
    this.stress = told.fields.stress ? new Field(packed, "stress") : null;
    this.trust = new Trust(packed);
    /** @type {Map<string, Recording>} */
    this.recordings = new Map(Object.keys(told.recordings).map((name) => [name, new Recording(packed, name)]));
    this.run = new Run(new Recurrence(packed), told.start, told.dt, MOST);
    this.cursor = 0; // of steps, with its fraction
    this.case = told.cases[told.first];
    this.take(told.first);
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
    this.run.again(Math.ceil(this.cursor - 1e-9));
    this.trust.forget();
    this.cursor = Math.min(this.cursor, this.run.steps);
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

  /** Coordinates of stress in the step that is shown; none where they follow from x̂. */
  get shat() {
    return this.run.stresses[this.step];
  }

  /**
   * Stress [n, 6] [Pa] of some points, as it is shown.
   * @param {Field} stress its field
   * @param {Uint32Array} rows of the points
   */
  stressOf(stress, rows) {
    return this.shat.length ? stress.of(this.shat, rows, 6) : stress.at(this.xhat, this.parameters, rows, 6);
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
    return this.trust.light(this.run, this.parameters, this.step, this.step === this.told.steps);
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
    this.trust.forget(Math.floor(this.run.steps / this.run.recurrence.stride) + 1);
  }
}

/** Plays and steers the model; see `Player` in `page.mjs`. */
export class LivePlayer extends Live {
  /** @param {import("./data.mjs").Packed} packed */
  constructor(packed) {
    super(packed);
    const { told } = this, first = (told.dt * told.steps) / SHOWN_IN, off = (/** @type {number} */ v) => Math.abs(Math.log(v / first));
    this.about = `a reduced model that runs in this page: ${counted(told.points, told.particles)}, ${told.latents} latent coordinates, ${told.run}`;
    this.color = this.stress ? "von_mises" : "displacement";
    this.pace = 1 / told.dt;
    this.speeds = SPEEDS.map((v) => /** @type {[string, string]} */ ([String(v), `${v} ×`]));
    this.speed = String(SPEEDS.reduce((best, own) => (off(own) < off(best) ? own : best)));
    /** @type {any[]} */ this.sliders = [];
    /** @type {{ index: number, own: any }[]} */ this.handles = [];
    /** @type {Tilt | null} */ this.pad = null;
    /** @type {Map<string, import("./body.mjs").Body>} full-order runs */ this.truths = new Map();
    this.beside = [0, 0, 0];
  }

  get t() {
    return this.cursor * this.told.dt;
  }

  get stuck() {
    return this.run.diverged;
  }

  get length() {
    return Math.max(this.told.steps, this.byHand ? this.run.steps : 0);
  }

  reset() {
    super.reset();
    this.pad?.upright();
  }

  /** @param {number} dx [pixel] @param {number} dy [pixel] */
  drag(dx, dy) {
    return this.pad?.drag(dx, dy) ?? false;
  }

  /** @param {import("./drawing.mjs").Drawing} drawing */
  place(drawing) {
    const { told } = this;
    this.drawing = drawing;
    const { corners, faces } = this.arrays;
    this.body = drawing.body(this.rest);
    this.body.surface = Surface.of(this.arrays);
    this.beside = drawing.camera.beside();
    for (const [name, own] of this.recordings) {
      const outer = corners && own.points === corners.length;
      const body = drawing.body(own.rest, this.beside, outer ? told.radius : told.radius * Math.cbrt(told.points / own.points));
      body.surface = outer ? new Surface(corners.map((_, row) => row), faces) : null;
      this.truths.set(name, body);
    }
  }

  /** @param {import("./page.mjs").Page} page */
  controls(page) {
    const { told } = this, change = () => page.change();
    this.sliders = sliders(told.parameters, this.case.values, (values) => {
      this.steer(values, find("from").value === "here");
      change();
    });
    this.pad = told.gravity ? new Tilt(told.gravity, () => page.camera.axes, (gravity) => {
      this.tilt(gravity);
      if (gravity) page.set(true);
      change();
    }) : null;
    this.handles = this._handles(page);
    const cases = told.cases.map((/** @type {{ label: string }} */ own, /** @type {number} */ i) => [String(i), own.label]);
    const take = (/** @type {string} */ index) => {
      this.take(Number(index));
      this.pad?.upright();
      this.sliders.forEach((own, i) => own.show(this.case.values[i]));
      change();
    };
    const truth = tick("truth", "full-order run beside it", (on) =>
      page.reach(on ? told.upper.map((/** @type {number} */ v, /** @type {number} */ c) => v + this.beside[c]) : told.upper));
    const picture = () => {
      page.drawing.level = 0;
      page.draw();
      find("canvas").toBlob((/** @type {Blob} */ png) => download(`${told.file}.png`, png));
    };
    const keep = () => download(`${told.file}.csv`, new Blob([this.table()], { type: "text/csv" }));
    return [
      ...(this.pad ? [this.pad.made] : []),
      ...this.sliders.map((own) => own.made),
      choice("from", "moved sliders act", [["start", "from t = 0"], ["here", "from now on"]], "start", () => {}),
      ...this.handles.map(({ own }) => own.made),
      choice("case", "held-out case", cases, String(told.first), take),
      ...(this.recordings.size ? [element("div", {}, truth, element("small", { id: "sides" }))] : []),
      element("div", { className: "bar" }, button("picture", "Keep picture", picture), button("table", "Keep latent trajectory", keep)),
    ];
  }

  /** @param {string} color */
  draw(color) {
    const { xhat, parameters, told, rest } = this, { top } = told.quantities[color], byStress = color === "von_mises" ? this.stress : null;
    const x = this.deformation.at(xhat, parameters);
    this.body?.show(x, (rows) => byStress ? vonMises(this.stressOf(byStress, rows), top, rows.length) : displacement(x, rest, top, rows));
    const wanted = this.held && this.recordings.size && find("truth").checked ? this.case.recording : null;
    for (const [name, own] of this.truths) {
      own.visible = name === wanted;
      const run = this.recordings.get(name);
      if (!own.visible || !run) continue;
      const found = run.at(run.frameAt(this.t));
      own.show(found.x, (rows) => byStress ? found.stressOf(rows) : displacement(found.x, run.rest, top, rows));
    }
    if (this.drawing) this.drawing.solids = this.run.solids;
  }

  tell() {
    for (const { index, own } of this.handles)
      if (!own.input.matches(":active, :focus-visible")) own.show(along(this.run.solids[index], this.t));
    if (this.recordings.size) {
      const stored = this.held && this.case.recording ? "Left: the reduced run; right: the full-order one." : "No full-order run of this was stored.";
      find("sides").textContent = find("truth").checked ? stored : "";
    }
    return { light: this.light(), note: `Strides of ${Number((this.told.dt * this.run.recurrence.stride).toPrecision(3))} s by a recurrence.` };
  }

  /** @param {import("./page.mjs").Page} page */
  _handles(page) {
    return this.case.solids.flatMap((/** @type {import("./solids.mjs").Solid} */ solid, /** @type {number} */ index) => {
      if (!solid.movable) return [];
      const { low, high } = solid.movable, step = (high - low) / 200;
      const p = { name: `place of ${solid.name}`, unit: "m", lower: low, upper: high, step, trained: [low, high] };
      return [{ index, own: slider(p, 0, (place) => {
        this.move(index, place);
        page.set(true);
        page.change();
      }) }];
    });
  }
}
