// Calls one function of the page after another: [[name, ...arguments], ...] in, their results out.
//   node parts.mjs JOB.json > RESULTS.json
import { readFileSync } from "node:fs";

import { Drives } from "../../page/recording/drives.js";
import { Hand } from "../../page/recording/hand.js";
import { drive, standing } from "../../page/simulation/drive.js";
import { Frechet } from "../../page/simulation/frechet.js";
import { boxDistance, polar, wrapAngle } from "../../page/simulation/geometry.js";
import { scan, sectors } from "../../page/simulation/lidar.js";
import { mixture, rgb } from "../../page/view/colors.js";
import { decode, encode } from "../../page/view/link.js";
import { onSimplex, withWeight } from "../../page/view/triangle.js";

const PARTS = {
  boxDistance,
  decode,
  encode,
  mixture,
  onSimplex,
  polar,
  rgb,
  withWeight,
  wrapAngle,
  ranges: (...given) => Array.from(scan(...given)),
  sectors: (ranges, count) => Array.from(sectors(Float32Array.from(ranges), count)),
  drive(pose, command, robot, steps) {
    const body = standing(pose);
    for (let step = 0; step < steps; step++) drive(body, command, robot);
    return body;
  },
  frechet(path, other) {
    const frechet = new Frechet(path);
    for (const point of other) frechet.add(...point);
    return [frechet.distance, frechet.soFar];
  },
  // Commands of a hand, one a control step; before each, keys go down or up, a stick or a pointer moves.
  hand(pose, robot, moments) {
    const hand = new Hand();
    const body = standing(pose);
    return moments.map(({ down = [], up = [], stick, target }) => {
      down.forEach((code) => hand.key(code, true));
      up.forEach((code) => hand.key(code, false));
      if (stick !== undefined) hand.stick = () => stick;
      if (target !== undefined) hand.target = target;
      return hand.command(body, robot);
    });
  },
  // What becomes of drives whose episodes are at these moments.
  drives(episodes) {
    const drives = new Drives();
    const said = episodes.map((moments) => {
      moments.forEach((moment) => drives.add(moment));
      return drives.finish(moments[moments.length - 1]);
    });
    return { said, csv: drives.csv, boxes: drives.boxesCsv };
  },
};

const job = JSON.parse(readFileSync(process.argv[2], "utf8"));
console.log(JSON.stringify(job.calls.map(([name, ...given]) => PARTS[name](...given))));
