// Solids that the material meets: where they are, and their state as a recurrence takes it.

/** @typedef {{ times: number[], values: number[][] }} Keyframes */
/** @typedef {{ times: number[], translations: number[][], angles: number[], axis: number[], pivot: number[] }} Motion */
/**
 * @typedef {object} Solid
 * @property {string} name
 * @property {"half-space" | "sphere" | "cuboid"} shape
 * @property {number[]} position at rest [m]
 * @property {number[]} extents the normal, the radius, or half edges [m]
 * @property {number[]} orientation [9] at rest, by rows
 * @property {Motion | null} motion
 * @property {number} since [s]
 * @property {number | null} until [s]; null for ever
 * @property {{ axis: number[], low: number, high: number, speed: number } | null} [movable] by a hand: along which
 *   direction, from where to where [m], and how fast at most [m/s]
 */

const SAME_TIME = 1e-6; // of a step

/**
 * Values of keyframes at a time: linear between them, constant outside.
 * @param {Keyframes} keyframes
 * @param {number} t [s]
 * @returns {number[]}
 */
export function valueAt({ times, values }, t) {
  const last = times.length - 1;
  if (t <= times[0]) return values[0];
  if (t >= times[last]) return values[last];
  let k = 0;
  while (times[k + 1] < t) k++;
  const part = (t - times[k]) / (times[k + 1] - times[k]);
  return values[k].map((value, c) => value + part * (values[k + 1][c] - value));
}

/**
 * Shift [m] and angle [rad] from the pose at rest.
 * @param {Motion | null} motion
 * @param {number} t [s]
 */
export function poseAt(motion, t) {
  if (!motion) return [0, 0, 0, 0];
  const { times, translations, angles } = motion;
  return valueAt({ times, values: translations.map((shift, k) => [...shift, angles[k]]) }, t);
}

/**
 * How far along its direction a solid that a hand may move has come [m].
 * @param {Solid} solid
 * @param {number} t [s]
 */
export function along(solid, t) {
  const shift = poseAt(solid.motion, t);
  return (solid.movable?.axis ?? []).reduce((sum, v, c) => sum + v * shift[c], 0);
}

/**
 * The solid as a hand moves it from a time on, to a place along its direction, and lets it stand there.
 * @param {Solid} solid
 * @param {number} t [s]
 * @param {number} place [m]
 * @returns {Solid}
 */
export function moved(solid, t, place) {
  if (!solid.movable || !solid.motion) return solid;
  const { axis, speed } = solid.movable, { motion } = solid, way = place - along(solid, t);
  const past = motion.times.filter((own) => own < t).length, [x, y, z, angle] = poseAt(motion, t);
  const there = [x, y, z].map((v, c) => v + way * axis[c]);
  const times = [...motion.times.slice(0, past), t, t + Math.max(Math.abs(way) / speed, 1e-9)];
  const translations = [...motion.translations.slice(0, past), [x, y, z], there];
  return { ...solid, motion: { ...motion, times, translations, angles: [...motion.angles.slice(0, past), angle, angle] } };
}

/**
 * Whether a solid acts in the step that begins at a time.
 * @param {Solid} solid
 * @param {number} t [s]
 */
export function acts(solid, t) {
  return t >= solid.since && t < (solid.until ?? Infinity);
}

/**
 * State of all solids in step n [9 each]: shift and angle, how both change in the step, and whether they act.
 * @param {Solid[]} solids
 * @param {number} n
 * @param {number} dt [s]
 */
export function stateOf(solids, n, dt) {
  const found = [];
  for (const solid of solids) {
    const [here, next] = [n, n + 1].map((k) => poseAt(solid.motion, k * dt));
    found.push(...here, ...next.map((value, c) => value - here[c]), acts(solid, n * dt + SAME_TIME * dt) ? 1 : 0);
  }
  return found;
}

/**
 * A solid's pose as a matrix [16], by columns, from its own axes to the domain.
 * @param {Solid} solid
 * @param {number} t [s]
 */
export function placed(solid, t) {
  const [x, y, z, angle] = poseAt(solid.motion, t), { position, orientation } = solid;
  const [pivot, axis] = solid.motion ? [solid.motion.pivot, solid.motion.axis] : [[0, 0, 0], [0, 0, 1]];
  const turn = turned(axis, angle), arm = position.map((value, c) => value - pivot[c]);
  const rows = [0, 1, 2].map((i) => [
    ...[0, 1, 2].map((j) => [0, 1, 2].reduce((sum, k) => sum + turn[i][k] * orientation[3 * k + j], 0)),
    pivot[i] + [x, y, z][i] + [0, 1, 2].reduce((sum, k) => sum + turn[i][k] * arm[k], 0),
  ]);
  return Float32Array.from([0, 1, 2, 3].flatMap((j) => [rows[0][j], rows[1][j], rows[2][j], j === 3 ? 1 : 0]));
}

/**
 * Rotation by rows about a unit axis.
 * @param {number[]} axis
 * @param {number} angle [rad]
 */
function turned([x, y, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), o = 1 - c;
  return [
    [c + x * x * o, x * y * o - z * s, x * z * o + y * s],
    [y * x * o + z * s, c + y * y * o, y * z * o - x * s],
    [z * x * o - y * s, z * y * o + x * s, c + z * z * o],
  ];
}
