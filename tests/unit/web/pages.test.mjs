// The modules of the pages, under node: `node --test tests/unit/web`.

import assert from "node:assert/strict";
import { test } from "node:test";

import { Body } from "../../../nsf/live/web/body.mjs";
import { Camera } from "../../../nsf/live/web/camera.mjs";
import { prefixed, valued } from "../../../nsf/live/web/controls.mjs";
import { Recording, undifferenced, unpacked } from "../../../nsf/live/web/data.mjs";
import { Pace } from "../../../nsf/live/web/drawing.mjs";
import { Field, Network, displacement, vonMises } from "../../../nsf/live/web/field.mjs";
import { Recurrence, Run } from "../../../nsf/live/web/recurrence.mjs";
import { acts, along, moved, placed, poseAt, stateOf, valueAt } from "../../../nsf/live/web/solids.mjs";
import { Surface } from "../../../nsf/live/web/surface.mjs";
import { tilted } from "../../../nsf/live/web/tilt.mjs";
import { Trust, lightOf, quantity } from "../../../nsf/live/web/trust.mjs";

const near = (found, wanted, off = 1e-12) => {
  assert.equal(found.length, wanted.length);
  wanted.forEach((value, i) => assert.ok(Math.abs(found[i] - value) <= off, `${found} is not ${wanted}`));
};

/** A buffer as `nsf.live.page.packed` makes it. */
function packed(header, arrays) {
  const kinds = new Map([[Float32Array, "f4"], [Float64Array, "f8"], [Int16Array, "i2"], [Uint8Array, "u1"]]);
  const told = Object.fromEntries(Object.entries(arrays).map(([k, a]) => [k, { shape: [a.length], type: kinds.get(a.constructor) }]));
  let text = JSON.stringify({ ...header, arrays: told });
  while ((4 + text.length) % 8) text += " ";
  const padded = Object.values(arrays).map((a) => Math.ceil(a.byteLength / 8) * 8);
  const bytes = new Uint8Array(4 + text.length + padded.reduce((a, b) => a + b, 0));
  new DataView(bytes.buffer).setUint32(0, text.length, true);
  bytes.set(new TextEncoder().encode(text), 4);
  let at = 4 + text.length;
  Object.values(arrays).forEach((a, i) => {
    bytes.set(new Uint8Array(a.buffer), at);
    at += padded[i];
  });
  return bytes.buffer;
}

test("arrays are read in place, whatever their kinds", () => {
  const arrays = { a: Int16Array.of(1, -2, 3), b: Float64Array.of(0.1), c: Uint8Array.of(255), d: Float32Array.of(0.5, 2) };
  const { header, arrays: found } = unpacked(packed({ title: "x" }, arrays));
  assert.equal(header.title, "x");
  for (const [name, own] of Object.entries(arrays)) assert.deepEqual([...found[name]], [...own]);
});

test("planes come back from their differences, over the end of their type", () => {
  assert.deepEqual([...undifferenced(Uint8Array.of(250, 3, 10, 255), 2, 1)], [250, 3, 4, 2]);
  // 300, 5 then 299, 6: differences 65535 and 1; low bytes before high ones.
  assert.deepEqual([...undifferenced(Uint8Array.of(44, 5, 255, 1, 1, 0, 255, 0), 2, 2)], [300, 5, 299, 6]);
});

test("a recording is linear between its frames", () => {
  const low = Uint8Array.of(0, 0, 0, 255, 0, 0, 0, 255, 0), high = Uint8Array.of(0, 0, 0, 255, 0, 0, 0, 255, 0);
  const header = { recordings: { run: { t: [0, 0.5], points: 1, lower: [0, 0, 0], upper: [2, 4, 6] } } };
  const arrays = { "run.x": Uint8Array.of(...low, ...high), "run.stress": Uint8Array.of(0, 255) };
  const run = new Recording({ header, arrays }, "run");
  near(run.rest, [0, 0, 0]);
  near(run.at(0).x, [2, 0, 0]);
  near(run.at(0.5).x, [2, 2, 0]);
  near(run.at(0.5).stressOf(Uint32Array.of(0)), [0.5]);
  near(run.at(9).x, [2, 4, 0]);
  assert.equal(run.frameAt(0.25), 0.5);
  assert.equal(run.frameAt(7), 1);
});

const silu = (z) => z / (1 + Math.exp(-z));

test("a network has SiLU between its layers, and none after the last", () => {
  const arrays = {
    "n.weight0": Float32Array.of(1, 2, -1, 0), "n.bias0": Float32Array.of(0.5, 1),
    "n.weight1": Float32Array.of(2, -3), "n.bias1": Float32Array.of(-1),
  };
  const network = new Network({ header: {}, arrays }, "n", 2);
  network.inputs.set([0.25, -1]);
  near(network.outputs(), [2 * silu(-1.25) - 3 * silu(0.75) - 1]);
});

test("a field is mean and modes times latents, then the closure", () => {
  const header = { fields: { f: { leading: 1, layers: 1, parameters: true } } };
  const arrays = {
    "f.mean": Float32Array.of(1, 2, 3), "f.scale": Float32Array.of(0.5, 0.25),
    "f.modes": Int16Array.of(2, 4, 0, 8, -2, 0), "f.weight0": Float32Array.of(1, 10), "f.bias0": Float32Array.of(1),
  };
  // a = [2, 1 + 2 + 10 · 3]
  const field = new Field({ header, arrays }, "f");
  near(field.at([2], [3]), [1 + 2 + 33, 2 + 66, 3 - 2]);
  near(field.at([2], [3], Uint32Array.of(2, 0), 1).subarray(0, 2), [3 - 2, 1 + 2 + 33]);
});

test("von Mises of shear and of pressure; displacement", () => {
  const tau = Float32Array.of(0, 2, 0, 0, 0, 0, 5, 0, 0, 5, 0, 5, 3, 0, 0, 0, 0, 0);
  near(vonMises(tau, 2, 3), [Math.sqrt(3), 0, 1.5], 1e-6);
  near(displacement(Float32Array.of(9, 9, 9, 3, 4, 0), [0, 0, 0, 0, 0, 0], 10, Uint32Array.of(1)), [0.5], 1e-6);
});

/**
 * A recurrence of one latent without inner layers: B = 0.5 + x̂, f = μ, G = [0, 0, 2]; a state adds to f.
 * @param {number} states of solids
 * @param {number} stride
 */
function recurrence(states, stride = 1) {
  const header = { recurrence: { latents: 1, stress: 0, gravity: true, stride, members: 1, layers: 1 } };
  const n = 2 + states, weight = new Float64Array(5 * n);
  weight[0] = weight[n + 1] = 1;
  if (states === 1) weight[n + 2] = 1;
  const arrays = { "motion0.weight0": weight, "motion0.bias0": Float64Array.of(0.5, 0, 0, 0, 2) };
  return new Recurrence({ header, arrays });
}

test("a step by a recurrence", () => {
  const made = recurrence(1), [next] = made.step(made.begin({ xhat: [1], change: [0.1] }), [0.3], [9, 9, -0.1], [0.05]);
  // d' = 0.1 + (0.5 + 1) 0.1 + (0.3 + 0.05) + 2 (−0.1)
  near(next.change, [0.4]);
  near(next.xhat, [1.4]);
});

test("frames between strides lie on a parabola, and a run that is rewound begins its stride again", () => {
  const made = new Run(recurrence(0, 2), { xhat: [0], change: [0] }, 0.1, 100);
  made.parameters = [0.1];
  made.advance(3);
  assert.equal(made.steps, 4);
  // d = 0, then 0.1: half of the way a quarter of the parabola, 0.5 · ½ (0 + 0.1 + ½ 0.1)
  near(made.latents[1], [0.0375]);
  near(made.latents[2], [0.1]);
  const kept = made.latents.map((xhat) => xhat[0]);
  made.rewind(3);
  assert.equal(made.steps, 2);
  made.advance(2);
  near(made.latents.map((xhat) => xhat[0]), kept, 1e-14);
});

function run() {
  const made = new Run(recurrence(9), { xhat: [0], change: [0] }, 0.1, 100);
  made.parameters = [0.001];
  const state = { name: "s", shape: "sphere", position: [0, 0, 0], extents: [1, 0, 0], orientation: [1, 0, 0, 0, 1, 0, 0, 0, 1], motion: null, since: 0, until: null };
  made.solids = [state];
  return made;
}

test("a run that is rewound and goes on is the same run", () => {
  const one = run(), other = run();
  one.advance(9);
  other.advance(7);
  other.rewind(5);
  assert.equal(other.steps, 5);
  other.advance(4);
  one.latents.forEach((xhat, n) => near(other.latents[n], xhat, 1e-14));
  other.again(9);
  one.latents.forEach((xhat, n) => assert.deepEqual(other.latents[n], xhat));
});

test("a hand on gravity acts from its moment on, also when the run is made anew", () => {
  const one = run();
  one.advance(5);
  one.hand = [0, 0, 0.5];
  one.advance(5);
  const before = one.latents.map((xhat) => xhat[0]);
  assert.deepEqual(one.gravities.map((g) => g[2]), [0, 0, 0, 0, 0, 0.5, 0.5, 0.5, 0.5, 0.5]);
  one.again(10);
  near(one.latents.map((xhat) => xhat[0]), before, 0);
  one.restart();
  one.advance(10);
  assert.notEqual(one.latents[10][0], before[10]);
});

test("a run ends where it is not finite, and at the most steps that are kept", () => {
  const lost = run();
  lost.parameters = [NaN];
  lost.advance(4);
  assert.deepEqual([lost.diverged, lost.steps], [true, 0]);
  const long = run();
  long.parameters = [0];
  long.advance(1000);
  assert.equal(long.steps, 100);
});

test("keyframes are linear between and constant outside", () => {
  const gravity = { times: [0, 1], values: [[0, 0, -4], [2, 0, -4]] };
  near(valueAt(gravity, 0.25), [0.5, 0, -4]);
  near(valueAt(gravity, -1), [0, 0, -4]);
  near(valueAt(gravity, 9), [2, 0, -4]);
});

const SPIN = {
  name: "s", shape: "cuboid", position: [1, 0, 0], extents: [1, 1, 1], orientation: [1, 0, 0, 0, 1, 0, 0, 0, 1], since: 0.1, until: 0.3,
  motion: { times: [0, 1], translations: [[0, 0, 0], [0, 0, 2]], angles: [0, Math.PI], axis: [0, 0, 1], pivot: [0, 0, 0] },
};

test("a solid's pose and state", () => {
  near(poseAt(SPIN.motion, 0.5), [0, 0, 1, Math.PI / 2]);
  const pose = placed(SPIN, 0.5);
  near(pose.slice(12, 15), [0, 1, 1], 1e-6); // its centre went round by a quarter, and up
  near(pose.slice(0, 3), [0, 1, 0], 1e-6);
  near(stateOf([SPIN], 1, 0.1), [0, 0, 0.2, 0.1 * Math.PI, 0, 0, 0.2, 0.1 * Math.PI, 1]);
  assert.deepEqual([0.05, 0.1, 0.29, 0.3].map((t) => acts(SPIN, t)), [false, true, true, false]);
});

test("a hand moves a solid from where it is, no faster than it may, and keeps what was", () => {
  const own = { ...SPIN, movable: { axis: [0, 0, 1], low: -1, high: 3, speed: 4 } };
  const found = moved(own, 0.5, 3);
  assert.equal(along(own, 0.5), 1);
  near([0.25, 0.5, 0.75, 1, 9].map((t) => along(found, t)), [0.5, 1, 2, 3, 3]);
  near(poseAt(found.motion, 0.25), poseAt(own.motion, 0.25));
  near(poseAt(found.motion, 9), [0, 0, 3, Math.PI / 2]);
  assert.equal(moved(SPIN, 0.5, 3), SPIN);
});

test("gravity is tilted as the viewer sees it, and keeps its size", () => {
  const camera = new Camera([0, 0, 0], [1, 1, 1], () => {});
  camera.azimuth = -Math.PI / 2; // from the south: right is east, ahead is north
  near(tilted([0, 0, -4], camera.axes, 0, 0), [0, 0, -4]);
  near(tilted([0, 0, -4], camera.axes, Math.PI / 6, 0), [2, 0, -4 * Math.cos(Math.PI / 6)], 1e-9);
  near(tilted([0, 0, -4], camera.axes, 0, Math.PI / 6), [0, 2, -4 * Math.cos(Math.PI / 6)], 1e-9);
});

function trust(changed = {}) {
  const header = {
    parameters: [{ name: "angle", unit: "°" }],
    trust: {
      limit: 0.2,
      metric: [[2]],
      reach: { names: ["angle"], box: [[20, 40]], gravity: [0, 0, -4], radius: 0.5, solids: null, states: { low: [0], high: [2], leeway: 0.1 }, changed: "" },
      calibration: { t: [0, 1], curve: [0, 0.02], slope: 2, factor: 1.5, typical: 1, displacement: 1, errors: [0.02, 0.02], lost: 0 },
      validated: [[30], [25]],
      ...changed,
    },
  };
  return new Trust({ header, arrays: {} });
}

/** A run of two strides of 1 s whose two members are so far apart at its end. */
function strided(apart, end = 0.5, gravity = [0, 0, -4]) {
  const state = (x) => [{ xhat: [x - apart / 4] }, { xhat: [x + apart / 4] }];
  return { recurrence: { stride: 1, motions: [0, 0] }, dt: 1, steps: 2, diverged: false, start: { xhat: [0] }, gravities: [gravity, gravity], states: [state(0), state(0.5), state(end)] };
}

test("the light is the bound's, and names its reason", () => {
  // It moves by 0, 1 and 1 m: D² = 0.75 m². Members are 0.1 m apart: a signal of 0.1 / √2 m.
  const light = (made, parameters = [30], own = trust()) => own.light(made, parameters, 2, true);
  assert.deepEqual(light(strided(0)), { level: "green", text: "green: expected error 1.73 %, at most 2.6 % of the displacement" });
  const apart = light(strided(0.1));
  assert.equal(apart.level, "red");
  assert.match(apart.text, /expected error 16.3 %, at most 24.5 % of the displacement/);
  assert.match(light(strided(0), [35]).text, /at most 2.92 %/); // a quarter of the box away from a validation case
  assert.equal(light(strided(0), [41]).text.split("; ")[1], "angle=41° is outside of 20 … 40");
  assert.match(light(strided(0, 0.5, [0, 1, -4])).text, /^red: .*gravity is 1 m\/s² from that which was taught, 0.5 m\/s² at most/);
  assert.match(light(strided(0, 2)).text, /^red: .*its shape left those of the training runs at t = 2 s/);
  const rare = trust();
  rare.told.reach.usual = { rows: [[0], [1]], leeway: 0.1, every: 1 };
  assert.equal(light(strided(0), [30], rare).level, "green"); // it comes to 0, 1 and 1 m
  rare.forget();
  assert.match(light(strided(0, 0.7), [30], rare).text, /^red: .*its shape left those of the training runs at t = 2 s/);
  assert.equal(light({ ...strided(0), diverged: true }).level, "red");
  assert.equal(light(strided(0), [30], trust({ calibration: null })).text, "unknown: no validation run tells (set scene.design.validation)");
  assert.equal(new Trust({ header: { parameters: [] }, arrays: {} }).light(strided(0), [], 2, true).level, "unknown");
  assert.equal(lightOf(0.05, 0.15, 0.2, "").level, "amber");
});

test("numbers as text", () => {
  assert.equal(quantity(0.4, "-"), "0.4");
  assert.equal(valued(26, "°", 0.175), "26.00°");
  assert.equal(valued(1500, "Pa", 10), "1500 Pa");
  assert.equal(prefixed(5432, "Pa"), "5.43 kPa");
  assert.equal(prefixed(0.0123, "m"), "12.3 mm");
});

/** A block of points on a lattice, 20 of them on each side, a millimetre apart. */
const lattice = () => Float32Array.from({ length: 3 * 20 ** 3 }, (_, i) => {
  const p = Math.floor(i / 3);
  return 1e-3 * [p % 20, Math.floor(p / 20) % 20, Math.floor(p / 400)][i % 3];
});

test("a surface keeps its size, loses its roughness and faces outward", () => {
  // A rough ball of rings, whose corners are all points of a body but the first.
  const [rings, around] = [14, 20], at = (i, j) => 1 + (i - 1) * around + (j % around), places = [[9, 9, 9]], faces = [];
  for (let i = 1; i < rings; i++)
    for (let j = 0; j < around; j++) {
      const [a, b, size] = [(Math.PI * i) / rings, (2 * Math.PI * j) / around, 1 + 0.05 * ((i + j) % 2)];
      places.push([Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a)].map((v) => size * v));
      if (i < rings - 1) faces.push(at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j), at(i + 1, j + 1), at(i, j + 1));
    }
  const x = Float32Array.from(places.flat()), rows = places.map((_, p) => p).slice(1);
  const surface = new Surface(rows, faces.map((p) => p - 1)), body = new Body(x, 0.1, [10, 0, 0]);
  body.show(x, (of) => of);
  const drawn = surface.corners(body);
  for (let i = 4; i < rings - 4; i++) {
    const to = 7 * (at(i, 3) - 1), out = [drawn[to] - 10, drawn[to + 1], drawn[to + 2]], radius = Math.hypot(...out);
    assert.ok(Math.abs(radius - 1.025) < 0.02, `${radius}`);
    assert.ok(out.reduce((sum, v, c) => sum + v * drawn[to + 3 + c], 0) > 0.98 * radius);
    assert.equal(drawn[to + 6], at(i, 3));
  }
});

test("points are left out that others hide, and no other", () => {
  const rest = lattice(), body = new Body(rest, 0.8e-3, [0, 0, 0]), camera = new Camera([0, 0, 0], [0.02, 0.02, 0.02], () => {});
  body.show(rest, (rows) => rows);
  camera.approach(1.5); // so that the nearest corner is in the picture
  const view = camera.view(1.5), pixels = camera.pixels(600, 400);
  const rows = Array.from(body.seen(view, 600, 400, pixels, null).filter((_, i) => i % 4 === 3));
  assert.ok(rows.length < 0.35 * body.count, `${rows.length}`);
  // Every point of a side that the camera sees is there: of those at the top, and those towards it.
  const { toward } = camera.axes, sides = toward.map((v) => (v > 0 ? 19e-3 : 0));
  const outer = Array.from({ length: body.count }, (_, p) => p).filter((p) => [0, 1, 2].some((c) => Math.abs(rest[3 * p + c] - sides[c]) < 1e-6));
  assert.deepEqual(outer.filter((p) => !rows.includes(p)), []);
  // A cut shows what was inside.
  const cut = { x: [0.01, 0.01], across: [0.47, -0.88] };
  const inner = body.seen(view, 600, 400, pixels, cut).filter((_, i) => i % 4 === 3);
  assert.ok(inner.every((p) => (rest[3 * p] - 0.01) * 0.47 - (rest[3 * p + 1] - 0.01) * 0.88 <= 0));
  assert.ok(inner.some((p) => !rows.includes(p)));
  // Behind the camera none is seen.
  camera.centre = [0, 9, 0];
  assert.equal(body.seen(camera.view(1.5), 600, 400, pixels, null).length, 0);
});

test("a shadow lies on the floor, slanted, with few points in a place", () => {
  const rest = lattice(), body = new Body(rest, 0.8e-3, [1, 0, 0]), found = body.shadow(-1e-3, null);
  assert.ok(found.length / 4 < 0.2 * body.count);
  const places = Array.from({ length: found.length / 4 }, (_, k) => found.subarray(4 * k, 4 * k + 3));
  assert.ok(places.every(([x, y, z]) => Math.abs(z + 1e-3) < 1e-9 && x > 0.999 && x < 1.03 && y > -1e-6 && y < 0.03));
  // No place of the whole shadow is far from those that are drawn.
  for (let p = 0; p < body.count; p += 7) {
    const [x, y, z] = rest.subarray(3 * p, 3 * p + 3), at = [1 + x + 0.28 * (z + 1e-3), y + 0.175 * (z + 1e-3)];
    assert.ok(places.some(([a, b]) => Math.hypot(a - at[0], b - at[1]) < 2 * 0.8e-3));
  }
});

test("what moves is drawn coarser where it is slow, and whole once it stands", () => {
  const drawing = { level: 0 }, pace = new Pace(drawing);
  let now = 0;
  const frames = (count, each, changed) => Array.from({ length: count }, () => pace.draws((now += each), changed));
  assert.ok(frames(20, 16, true).every(Boolean));
  assert.equal(drawing.level, 0);
  frames(9, 80, true);
  assert.equal(drawing.level, 2);
  assert.deepEqual(frames(40, 16, false).filter(Boolean), [true]);
  assert.equal(drawing.level, 0);
  frames(2, 16, true);
  assert.equal(drawing.level, 1); // it was slow, and may have been so for a while only
  frames(99, 80, true);
  assert.equal(drawing.level, 3);
});
