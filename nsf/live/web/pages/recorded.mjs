// The player of a recorded run.

import { Camera } from "../camera.mjs";
import { button, choice, counted, element, fail, find, headed, keyed, legend, onLook, tick } from "../controls.mjs";
import { Recording, inflated, unpacked } from "../data.mjs";
import { Drawing, Pace } from "../drawing.mjs";
import { displacement } from "../field.mjs";

const HOLD = 0.7; // [s] for which the last frame stands before the run begins again

/** Show the run that the page holds. */
async function play() {
  const data = find("data"), packed = unpacked(await inflated(data.textContent));
  data.remove();
  const { header: told } = packed, run = new Recording(packed, "run"), F = run.frames;
  const state = { frame: 0, playing: true, color: told.color, changed: true };
  const stopped = told.stopped === null ? "" : `; diverged at t = ${told.stopped.toPrecision(3)} s, shown up to there`;
  headed(told.title, `reduced run ${told.run}, ${counted(told.points, told.particles)}${stopped} · drag turns, shift-drag moves, the wheel zooms, a double click resets`);

  const frame = element("input", { id: "frame", type: "range", min: 0, max: F - 1, value: 0, step: 1, ariaLabel: "frame" });
  const time = element("output", { id: "time" });
  const set = (/** @type {boolean} */ on) => {
    state.playing = on;
    if (on && state.frame >= F - 1) state.frame = 0;
    find("play").textContent = on ? "Pause" : "Play";
  };
  const seek = (/** @type {number} */ to) => {
    set(false);
    state.frame = Math.max(0, Math.min(F - 1, to));
    state.changed = true;
  };
  const paint = (/** @type {string} */ color) => {
    state.color = find("color").value = color;
    state.changed = true;
    legend(told.quantities[color], told.colors);
  };
  frame.oninput = () => seek(Number(frame.value));
  const speeds = ["0.25", "0.5", "1", "2"].map((v) => /** @type {[string, string]} */ ([v, `${v} ×`]));
  const colors = /** @type {[string, string][]} */ ([["von_mises", "von Mises stress"], ["displacement", "displacement"]]);
  const cut = tick("cut", "cut open", (on) => {
    drawing.cut = on;
    state.changed = true;
  });
  find("panel").append(
    element("div", { className: "bar" }, button("play", "Pause", () => set(!state.playing), "space"), frame),
    time,
    choice("speed", "speed", speeds, "1", () => {}),
    choice("color", "colour", colors, state.color, paint),
    cut,
  );
  const camera = new Camera(run.lower, run.upper, () => { state.changed = true; });
  const drawing = new Drawing(find("canvas"), camera, told), body = drawing.body(run.rest);
  drawing.solids = told.solids;
  const draw = () => {
    const { x, stressOf } = run.at(state.frame), k = Math.floor(state.frame), after = Math.min(k + 1, F - 1);
    const t = run.t[k] + (state.frame - k) * (run.t[after] - run.t[k]);
    const top = told.quantities.displacement.top;
    body.show(x, state.color === "von_mises" ? stressOf : (rows) => displacement(x, run.rest, top, rows));
    drawing.time = t;
    drawing.draw();
    time.textContent = `t = ${t.toFixed(3)} s`;
    frame.value = Math.round(state.frame);
    document.body.dataset.frame = state.frame.toFixed(2);
  };
  const pace = new Pace(drawing);
  let last = performance.now(), beyond = 0;
  const next = (/** @type {number} */ now) => {
    const passed = Math.max(0, Math.min(0.2, (now - last) / 1000));
    last = now;
    if (state.playing) {
      const gone = state.frame + passed * told.fps * Number(find("speed").value);
      beyond = gone > F - 1 ? beyond + passed : 0;
      state.frame = beyond > HOLD ? 0 : Math.min(gone, F - 1);
      state.changed ||= beyond === 0 || beyond <= passed;
    }
    if (pace.draws(now, state.changed)) draw();
    state.changed = false;
    requestAnimationFrame(next);
  };
  camera.follow(find("canvas"));
  onLook(() => { state.changed = true; });
  const step = (/** @type {number} */ by) => seek(Math.round(state.frame) + by);
  keyed({ " ": () => set(!state.playing), ArrowLeft: () => step(-1), ArrowRight: () => step(1) });
  const asked = new URLSearchParams(location.hash.slice(1)), color = asked.get("color") ?? "";
  paint(color in told.quantities ? color : told.color);
  if (asked.has("frame")) seek(Number(asked.get("frame")) || 0);
  requestAnimationFrame(next);
  Object.assign(window, { nsf: { state, run } });
  document.body.dataset.ready = "true";
}

play().catch(fail);
