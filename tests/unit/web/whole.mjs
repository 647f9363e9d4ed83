// The whole run of every held-out case of a page: `node whole.mjs PAGE`; x̂, positions and stress as JSON.

import { readFileSync } from "node:fs";

import { inflated, unpacked } from "../../../nsf/live/web/data.mjs";
import { Live } from "../../../nsf/live/web/live.mjs";

const text = readFileSync(process.argv[2], "utf-8").match(/id="data">([^<]*)</)[1];
const live = new Live(unpacked(await inflated(text)));
const found = live.told.cases.map((own, index) => {
  live.take(index);
  live.reset();
  live.seek(live.told.steps);
  const { xhat, parameters } = live, x = Array.from(live.deformation.at(xhat, parameters));
  return { steps: live.run.steps, xhat: Array.from(xhat), x, tau: live.stress && Array.from(live.stressOf(live.stress, null)), light: live.light() };
});
const began = performance.now();
for (let k = 0; k < 10; k++) live.run.again(live.told.steps);
const each = (100 * (performance.now() - began)) / live.told.steps;
console.log(JSON.stringify({ found, each }));
