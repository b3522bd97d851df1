// Calls functions of the page: [name, ...arguments] a line in, a result a line out.
import { createInterface } from "node:readline";

import { Drives } from "../../page/recording/drives.js";
import { Hand } from "../../page/recording/hand.js";
import { SUBSTEPS, advance, standing } from "../../page/simulation/drive.js";
import { Episode } from "../../page/simulation/episode.js";
import { Frechet } from "../../page/simulation/frechet.js";
import { boxDistance, polar, wrapAngle } from "../../page/simulation/geometry.js";
import { scan, sectors } from "../../page/simulation/lidar.js";
import { mixture, rgb } from "../../page/view/colors.js";
import { decode, encode } from "../../page/view/link.js";
import { Session } from "../../page/view/session.js";
import { onSimplex, withWeight } from "../../page/view/triangle.js";
import { Previews, serve as answer } from "../../page/view/worker.js";

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
    for (let step = 0; step < steps * SUBSTEPS; step++) advance(body, command, robot);
    return body;
  },
  // Where the robot is after each of these commands, and how the episode ends.
  episode(scene, robot, commands) {
    const episode = new Episode(scene, robot);
    const poses = [];
    for (const command of commands) {
      if (episode.ending !== null) break;
      episode.step(command);
      poses.push(episode.pose);
    }
    return { poses, human: episode.human, ending: episode.ending };
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
  // The policy and the preference of a session after the person has begun to do this.
  motion(contents, motion) {
    const session = new Session(contents);
    session.preference = [1, 0, 0];
    session.setMotion(motion);
    return [session.policyName, session.preference];
  },
  // Where a session drives in twenty steps, and where its previews, which know no session, say that it will.
  ahead(contents, preference) {
    const session = new Session(contents);
    session.preference = preference;
    const there = { postMessage: (data) => serve.onmessage({ data: structuredClone(data) }) };
    const serve = { postMessage: (data) => there.onmessage({ data }) };
    answer(serve);
    globalThis.Worker = function () {
      return there;
    };
    const previews = new Previews("", contents);
    previews.ask({ moment: session.episode.moment(), name: session.policyName, preference, clamped: false });
    for (let step = 0; step < 20; step++) session.step();
    return [session.points, previews.own.points.slice(0, 21)];
  },
  // Where a person stands who was put to a place.
  put(contents, place) {
    const session = new Session(contents);
    session.move("human", ...place);
    return session.episode.human;
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

createInterface({ input: process.stdin }).on("line", (line) => {
  const [name, ...given] = JSON.parse(line);
  console.log(JSON.stringify(PARTS[name](...given)));
});
