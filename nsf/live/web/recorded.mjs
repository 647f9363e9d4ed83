// A run that a page holds frame by frame.

import { counted } from "./controls.mjs";
import { Recording } from "./data.mjs";
import { displacement } from "./field.mjs";
import { Surface } from "./surface.mjs";

/** Plays a recorded run; see `Player` in `page.mjs`. */
export class RecordedPlayer {
  /** @param {import("./data.mjs").Packed} packed */
  constructor(packed) {
    const told = packed.header, run = new Recording(packed, "run");
    const stopped = told.stopped === null ? "" : `; diverged at t = ${told.stopped.toPrecision(3)} s, shown up to there`;
    this.run = run;
    this.arrays = packed.arrays;
    this.told = { ...told, lower: run.lower, upper: run.upper };
    this.about = `reduced run ${told.run}, ${counted(told.points, told.particles)}${stopped} · drag turns, shift-drag moves, the wheel zooms, a double click resets`;
    /** @type {string} */ this.color = told.color;
    this.cursor = 0;
    this.end = this.length = run.frames - 1;
    /** @type {number} */ this.pace = told.fps;
    this.speeds = ["0.25", "0.5", "1", "2"].map((v) => /** @type {[string, string]} */ ([v, `${v} ×`]));
    this.speed = "1";
  }

  get t() {
    const { t } = this.run, k = Math.floor(this.cursor), after = Math.min(k + 1, this.end);
    return t[k] + (this.cursor - k) * (t[after] - t[k]);
  }

  /** @param {number} cursor */
  seek(cursor) {
    this.cursor = cursor;
  }

  /** @param {import("./drawing.mjs").Drawing} drawing */
  place(drawing) {
    this.body = drawing.body(this.run.rest);
    this.body.surface = Surface.of(this.arrays);
    drawing.solids = this.told.solids;
  }

  /** @param {string} color */
  draw(color) {
    const { x, stressOf } = this.run.at(this.cursor), { top } = this.told.quantities.displacement;
    this.body?.show(x, color === "von_mises" ? stressOf : (rows) => displacement(x, this.run.rest, top, rows));
  }
}
