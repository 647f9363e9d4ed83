// A recurrence as a page takes it: `node recurrence.mjs` reads layers and runs as JSON, and prints x̂ and ŝ of all members of each.

import { readFileSync } from "node:fs";

import { Recurrence } from "../../../nsf/live/web/recurrence.mjs";

const { header, arrays, runs } = JSON.parse(readFileSync(0, "utf-8"));
const recurrence = new Recurrence({ header, arrays });
const taken = runs.map(({ xhat, change, parameters, gravity, states }) => {
  let now = recurrence.begin({ xhat, change });
  return gravity.map((g, n) => {
    now = recurrence.step(now, parameters, g, states[n]);
    return now.map((own) => [Array.from(own.xhat), Array.from(own.stress)]);
  });
});
console.log(JSON.stringify(taken));
