// The page of `nsf serve`: it decodes the latent vectors that a server sends.

import { Camera } from "../camera.mjs";
import { button, element, fail, find, headed, keyed, legend, lit, onLook, slider, tick, valued } from "../controls.mjs";
import { unpacked } from "../data.mjs";
import { Drawing, Pace } from "../drawing.mjs";
import { Field, displacement } from "../field.mjs";
import { lightOf } from "../trust.mjs";

/** Follow the stream beside the page's own address, whose query holds the token where there is one. */
async function follow() {
  const query = location.search, answer = await fetch(`field${query}`);
  if (!answer.ok) throw new Error(await answer.text());
  const buffer = await answer.arrayBuffer(), packed = unpacked(buffer), { header: told, arrays } = packed;
  const field = new Field(packed, "deformation"), rest = arrays.rest;
  const state = {
    frames: 0, bytes: 0, drawn: 0, changed: false, t: 0, trust: 0, away: 0, diverged: false, playing: true,
    values: /** @type {number[]} */ ([]), newest: /** @type {Float32Array | null} */ (null), x: field.values,
  };
  headed(told.title, `reduced run ${told.run} · drag turns, shift-drag moves, the wheel zooms, a double click resets`);
  const light = element("div", { id: "light", role: "status" }), shown = element("output", { id: "shown" });
  const cost = element("small", { id: "cost" });
  const socket = new WebSocket(location.href.replace(/^http/, "ws").replace(/\/(\?|$)/, "/stream$1"));
  socket.binaryType = "arraybuffer";
  const send = (/** @type {object} */ wanted) => {
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(wanted));
  };
  const turn = () => send({ playing: !state.playing });
  const time = element("output", { id: "time" }), play = button("play", "Pause", turn, "space; for all who look");
  const sliders = told.parameters.map((/** @type {import("../controls.mjs").Parameter} */ p) =>
    slider(p, p.trained[0], () => {
      send({ values: sliders.map((/** @type {any} */ s) => Number(s.input.value)) });
    }),
  );
  const change = () => { state.changed = true; };
  const camera = new Camera(told.lower, told.upper, change), drawing = new Drawing(find("canvas"), camera, told);
  const pace = new Pace(drawing);
  const cut = tick("cut", "cut open", (on) => {
    drawing.cut = on;
    change();
  });
  find("panel").append(
    element("div", { className: "row" }, play, time), ...sliders.map((/** @type {any} */ s) => s.made), light, cut, shown, cost,
  );
  const body = drawing.body(rest);
  drawing.solids = told.solids;
  camera.follow(find("canvas"));
  onLook(change);
  keyed({ " ": turn });
  legend(told.quantities.displacement, told.colors);

  socket.onmessage = ({ data }) => {
    if (typeof data === "string") {
      Object.assign(state, JSON.parse(data));
      play.textContent = state.playing ? "Pause" : "Play";
      // While a slider is dragged, what is shown lags behind it.
      if (!sliders.some((/** @type {any} */ s) => s.input.matches(":active")))
        sliders.forEach((/** @type {any} */ s, /** @type {number} */ i) => s.show(state.values[i]));
      return;
    }
    state.frames++;
    state.bytes += data.byteLength;
    state.newest = new Float32Array(data);
  };
  socket.onclose = ({ code, reason }) => { find("fault").textContent = `closed (${code}) ${reason}; reload to join again`; };

  const draw = (/** @type {number} */ now) => {
    if (state.newest) {
      [state.t, state.trust] = state.newest;
      const x = field.at(state.newest.subarray(2), []);
      state.newest = null;
      body.show(x, (rows) => displacement(x, rest, told.quantities.displacement.top, rows));
      drawing.time = state.t;
      state.drawn++;
      change();
      lit(lightOf(state.trust, state.away, state.diverged));
      time.textContent = `t = ${state.t.toFixed(3)} s`;
      shown.textContent = told.parameters.map((/** @type {any} */ p, /** @type {number} */ i) => `${p.name} = ${valued(state.values[i], p.unit, p.step)}`).join(", ");
    }
    if (pace.draws(now, state.changed)) drawing.draw();
    state.changed = false;
    requestAnimationFrame(draw);
  };
  requestAnimationFrame(draw);
  let before = { frames: 0, bytes: 0 };
  setInterval(() => {
    const [frames, bytes] = [state.frames - before.frames, state.bytes - before.bytes];
    before = { frames: state.frames, bytes: state.bytes };
    const each = frames ? Math.round(bytes / frames) : 0;
    cost.textContent = `${frames} frames/s of ${each} bytes, after ${(buffer.byteLength / 1e6).toFixed(2)} MB once; `
      + `as particles ${((12 * told.particles) / 1e3).toFixed(1)} kB a frame`;
  }, 1000);
  Object.assign(window, { nsf: { state, socket } });
  document.body.dataset.ready = "true";
}

follow().catch(fail);
