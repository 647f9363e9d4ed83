// Steps of operators as a page takes them: `node recurrence.mjs` reads layers and runs as JSON, and prints x̂ of each.

import { readFileSync } from "node:fs";

import { Operators } from "../../../nsf/live/web/operators.mjs";

const { header, arrays, runs } = JSON.parse(readFileSync(0, "utf-8"));
const operators = new Operators({ header, arrays });
const taken = runs.map(({ xhat, change, parameters, gravity, states }) => {
  const x = Float64Array.from(xhat), d = Float64Array.from(change);
  return gravity.map((g, n) => {
    operators.step(x, d, parameters, g, states[n]);
    return Array.from(x);
  });
});
console.log(JSON.stringify(taken));
