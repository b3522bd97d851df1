// How long a control step takes on the page: what is sensed, the policy, and all of it with the drive.
//   python -m recipes.page && node benchmarks/page.mjs runs/page/index.html
import { readFileSync } from "node:fs";

import { contentsOf } from "../page/contents.js";
import { Session } from "../page/view/session.js";

const session = new Session(contentsOf(readFileSync(process.argv[2], "utf8")));
session.select("static", 12);

const times = { sense: [], policy: [], step: [] };
const timed = (name, action) => {
  const before = performance.now();
  const result = action();
  times[name].push(performance.now() - before);
  return result;
};
for (let episode = 0; episode < 60; episode++) {
  session.restart();
  while (!session.episode.ending) {
    const sensed = timed("sense", () => session.episode.sense());
    timed("policy", () => session.policy.command(sensed, session.preference));
    timed("step", () => session.step());
  }
}
for (const [name, values] of Object.entries(times)) {
  const sorted = values.sort((a, b) => a - b);
  const at = (share) => `${(1000 * sorted[Math.floor(share * (sorted.length - 1))]).toFixed(0)} us`;
  console.log(`${name}: median ${at(0.5)}, 95 % ${at(0.95)}, n ${sorted.length}, node ${process.version}`);
}
