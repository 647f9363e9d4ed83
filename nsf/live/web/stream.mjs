// A run that a server takes: it sends latent vectors, which the page decodes, or the particles themselves.

import { choice, counted, find, slider, sliders, tick, valued } from "./controls.mjs";
import { unpacked } from "./data.mjs";
import { Field, displacement } from "./field.mjs";
import { lightOf } from "./trust.mjs";

const SAMPLE = [0.84, 0.37, 0]; // colour of sample particles
const IN_SAMPLE = 2; // among the roles of particles

/** Follows a server; see `Player` in `page.mjs`. Its query holds the token where there is one. */
export class StreamPlayer {
  /** Load what is sent once, and join. */
  static async joined() {
    const answer = await fetch(`field${location.search}`);
    if (!answer.ok) throw new Error(await answer.text());
    return new StreamPlayer(await answer.arrayBuffer());
  }

  /** @param {ArrayBuffer} buffer */
  constructor(buffer) {
    const packed = unpacked(buffer), told = packed.header;
    this.told = told;
    this.about = `reduced run ${told.run}, ${counted(told.points, told.particles)} · drag turns, shift-drag moves, the wheel zooms, a double click resets`;
    this.rest = packed.arrays.rest;
    this.field = told.fields ? new Field(packed, "deformation") : null;
    this.color = told.color ?? "displacement";
    this.remote = true;
    this.cursor = this.t = this.pace = 0;
    this.end = this.length = told.steps ?? 0;
    /** @type {[string, string][]} */ this.speeds = [];
    this.speed = "1";
    this.once = buffer.byteLength;
    this.received = { frames: 0, bytes: 0 };
    this.rate = { frames: 0, bytes: 0 }; // in the last second
    this.made = 0; // latent steps a second, by the server
    this.error = this.bound = NaN; // shares of the displacement
    this.beside = [0, 0, 0];
    this.x = this.rest;
    /** @type {ArrayBuffer | null} */ this.newest = null;
    this.state = { values: /** @type {number[]} */ ([]), light: { flag: /** @type {import("./trust.mjs").Flag} */ ("unknown"), reason: "" }, playing: true, color: this.color, tilted: false, known: /** @type {number | null} */ (null) };
    this.socket = new WebSocket(location.href.replace(/#.*/, "").replace(/^http/, "ws").replace(/\/(\?|$)/, "/stream$1"));
    this.socket.binaryType = "arraybuffer";
    /** @type {any[]} */ this.sliders = [];
    /** @type {any[]} */ this.tilts = [];
  }

  /** @param {object} wish */
  send(wish) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(wish));
  }

  /** @param {boolean} on */
  play(on) {
    this.send({ playing: on });
  }

  /** @param {number} cursor */
  seek(cursor) {
    if (!this.field) this.send({ step: Math.round(cursor) });
  }

  /** @param {string} color */
  paint(color) {
    if (!this.field) this.send({ color }); // always: what the server last told may be older than the last wish
  }

  /** @param {import("./page.mjs").Page} page */
  controls(page) {
    const { told } = this;
    this.sliders = sliders(told.parameters, told.parameters.map((/** @type {any} */ p) => p.trained[0]), (values) => {
      this.send({ values });
      this.tilts.forEach((own) => own.show(0));
    });
    const { trained = 0, most = 0 } = told.tilt ?? {};
    const tilted = { unit: "°", lower: -most, upper: most, step: 0.1, trained: [-trained, trained] };
    this.tilts = (most ? ["x", "y"] : []).map((way) => slider({ ...tilted, name: `tilt along ${way}` }, 0, () => {
      const degrees = this.tilts.map((own) => Number(own.input.value));
      this.send({ tilt: degrees.some(Boolean) ? degrees : null });
    }));
    const cases = [["", "…"], ...(told.known ?? []).map((/** @type {{ label: string }} */ own, /** @type {number} */ i) => [String(i), own.label])];
    const known = choice("known", "with full-order run", /** @type {[string, string][]} */ (cases), "", (index) => {
      if (index) this.send({ values: told.known[Number(index)].values });
    });
    if (this.field) for (const id of ["frame", "step"]) setTimeout(() => { find(id).hidden = true; });
    this._listen(page);
    return [
      ...[...this.sliders, ...this.tilts].map((own) => own.made),
      ...(cases.length > 1 ? [known] : []),
      ...(this.field ? [] : [tick("sample", "sample particles", (on) => {
        if (this.sample) this.sample.visible = on;
        page.change();
      })]),
    ];
  }

  /** @param {import("./drawing.mjs").Drawing} drawing */
  place(drawing) {
    const { told, rest } = this;
    this.body = drawing.body(rest);
    drawing.solids = told.solids;
    if (this.field) return;
    this.beside = drawing.camera.beside();
    this.full = drawing.body(rest, this.beside);
    this.sample = drawing.body(rest, [0, 0, 0], 1.4 * told.radius, SAMPLE);
    this.full.visible = this.sample.visible = false;
  }

  /** Whether a frame has come. */
  fresh() {
    return this.newest !== null;
  }

  draw() {
    if (!this.newest) return;
    const buffer = this.newest;
    this.newest = null;
    if (this.field) {
      const [t, error, bound, ...xhat] = new Float32Array(buffer), x = this.field.at(xhat, []);
      Object.assign(this, { t, error, bound, x });
      this.body?.show(x, (rows) => displacement(x, this.rest, this.told.quantities.displacement.top, rows));
      return;
    }
    const { moment, x, shade, roles, "full.x": fullX, "full.shade": fullShade } = unpacked(buffer).arrays;
    [this.t, this.error, this.bound, this.cursor, this.made] = moment;
    this.x = x;
    const picked = (/** @type {import("./data.mjs").Numbers} */ values) => (/** @type {Uint32Array} */ rows) => Float32Array.from(rows, (p) => values[p]);
    this.body?.show(x, picked(shade));
    this.full?.show(fullX ?? this.rest, picked(fullShade ?? shade));
    if (this.full) this.full.visible = Boolean(fullX);
    this.sample?.show(x.map((value, i) => (roles[Math.floor(i / 3)] === IN_SAMPLE ? value : NaN)), picked(shade));
  }

  tell() {
    const { told, state, rate } = this;
    const named = told.parameters.map((/** @type {any} */ p, /** @type {number} */ i) => `${p.name} = ${valued(state.values[i] ?? NaN, p.unit, p.step)}`);
    const light = lightOf(this.error, this.bound, 1, state.light.reason, state.light.flag);
    if (!this.field) {
      const what = `${named.join(", ")}${state.tilted ? ", gravity tilted by hand" : ""}`, made = this.made ? `; ${Math.round(this.made)} latent steps a second` : "";
      const beside = state.known === null ? `no full-order run of this ${state.tilted ? "program" : "case"}` : "left: reduced, right: full-order";
      return { light, note: `${what}${made}; ${beside}` };
    }
    const each = rate.frames ? Math.round(rate.bytes / rate.frames) : 0;
    const cost = `${rate.frames} frames/s of ${each} bytes, after ${(this.once / 1e6).toFixed(2)} MB once; as particles ${((12 * told.particles) / 1e3).toFixed(1)} kB a frame`;
    return { light, note: `${named.join(", ")}; ${cost}` };
  }

  /** @param {import("./page.mjs").Page} page */
  _listen(page) {
    this.socket.onmessage = ({ data }) => {
      if (typeof data === "string") {
        this._told(JSON.parse(data), page);
        return;
      }
      this.received.frames++;
      this.received.bytes += data.byteLength;
      this.newest = data;
    };
    this.socket.onclose = ({ code, reason }) => { find("fault").textContent = `closed (${code}) ${reason}; reload to join again`; };
    let before = { ...this.received };
    setInterval(() => {
      this.rate = { frames: this.received.frames - before.frames, bytes: this.received.bytes - before.bytes };
      before = { ...this.received };
      page.change();
    }, 1000);
  }

  /**
   * Show what the server says of all who look.
   * @param {any} state
   * @param {import("./page.mjs").Page} page
   */
  _told(state, page) {
    const was = this.state;
    this.state = { ...was, ...state };
    page.playing(this.state.playing);
    // While a slider is dragged, what is shown lags behind it.
    if (!this.sliders.some((own) => own.input.matches(":active"))) this.sliders.forEach((own, i) => own.show(this.state.values[i]));
    if (was.tilted && !this.state.tilted && !this.tilts.some((own) => own.input.matches(":active"))) this.tilts.forEach((own) => own.show(0));
    if (this.state.color !== page.state.color) page.paint(this.state.color);
    const { known } = this.state, choices = document.getElementById("known");
    if (choices) /** @type {HTMLSelectElement} */ (choices).value = known === null ? "" : String(known);
    if (!this.field && (was.known === null) !== (known === null)) {
      const { upper } = this.told, beside = known === null ? [0, 0, 0] : this.beside;
      page.reach(upper.map((/** @type {number} */ v, /** @type {number} */ c) => v + beside[c]));
    }
    page.change();
  }
}
