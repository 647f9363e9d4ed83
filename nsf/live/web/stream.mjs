// The page of `nsf serve`: it decodes the latent vectors that a server sends.

import { Camera } from "./camera.mjs";
import { element, fail, find, headed, legend, lit, onLook, slider, valued } from "./controls.mjs";
import { unpacked } from "./data.mjs";
import { Drawing } from "./drawing.mjs";
import { Field, displacement } from "./field.mjs";
import { lightOf } from "./trust.mjs";

/** Follow the stream beside the page's own address, whose query holds the token where there is one. */
async function follow() {
  const query = location.search, answer = await fetch(`field${query}`);
  if (!answer.ok) throw new Error(await answer.text());
  const buffer = await answer.arrayBuffer(), packed = unpacked(buffer), { header: told, arrays } = packed;
  const field = new Field(packed, "deformation"), rest = arrays.rest;
  const state = {
    frames: 0, bytes: 0, drawn: 0, t: 0, trust: 0, away: 0, diverged: false,
    values: /** @type {number[]} */ ([]), newest: /** @type {Float32Array | null} */ (null), x: field.values,
  };
  headed(told.title, `reduced run ${told.run} · drag turns, shift-drag moves, the wheel zooms, a double click resets`);
  const light = element("div", { id: "light", role: "status" }), shown = element("output", { id: "shown" });
  const cost = element("small", { id: "cost" });
  const socket = new WebSocket(location.href.replace(/^http/, "ws").replace(/\/(\?|$)/, "/stream$1"));
  socket.binaryType = "arraybuffer";
  const sliders = told.parameters.map((/** @type {import("./controls.mjs").Parameter} */ p) =>
    slider(p, p.trained[0], () => {
      const values = sliders.map((/** @type {any} */ s) => Number(s.input.value));
      if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ values }));
    }),
  );
  find("panel").append(...sliders.map((/** @type {any} */ s) => s.made), light, shown, cost);
  /** @type {Drawing | null} */
  let drawing = null;
  const camera = new Camera(told.lower, told.upper, () => drawing?.draw());
  drawing = new Drawing(find("canvas"), camera, told);
  const body = drawing.body(rest), values = new Float32Array(told.points);
  drawing.solids = told.solids;
  camera.follow(find("canvas"));
  onLook(() => drawing?.draw());
  legend(told.quantities.displacement, told.colors);

  socket.onmessage = ({ data }) => {
    if (typeof data === "string") {
      Object.assign(state, JSON.parse(data));
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

  const draw = () => {
    if (state.newest) {
      [state.t, state.trust] = state.newest;
      const x = field.at(state.newest.subarray(2), []);
      state.newest = null;
      body.show(x, displacement(x, rest, told.quantities.displacement.top, values));
      drawing.time = state.t;
      drawing.draw();
      state.drawn++;
      lit(lightOf(state.trust, state.away, state.diverged));
      const at = told.parameters.map((/** @type {any} */ p, /** @type {number} */ i) => `${p.name} = ${valued(state.values[i], p.unit, p.step)}`);
      shown.textContent = `${at.join(", ")}, t = ${state.t.toFixed(3)} s`;
    }
    requestAnimationFrame(draw);
  };
  draw();
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
