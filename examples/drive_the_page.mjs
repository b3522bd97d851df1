// Records drives on the page as a visitor would, with a scripted hand: an S-curve past the person, on the right at 1.5 m.
//   python -m recipes.page && node examples/drive_the_page.mjs runs/page/index.html 10 > drives.csv
import { readFileSync } from "node:fs";

import { contentsOf } from "../page/contents.js";
import { Drives } from "../page/recording/drives.js";
import { Hand } from "../page/recording/hand.js";
import { Session } from "../page/view/session.js";

const BERTH = 1.5; // metres
const AHEAD = 0.7; // metres from the robot to where the hand points

const [file, count = "10"] = process.argv.slice(2);
const contents = contentsOf(readFileSync(file, "utf8"));

const session = new Session(contents);
const hand = new Hand();
const drives = new Drives();
session.driver = (episode) => {
  const command = hand.command(episode.body, contents.robot);
  if (command && !drives.points.length) drives.add(episode);
  return command;
};

// Metres beside the straight way to the goal, where the person stands at [along, beside]. Hands are not exact:
// each drive begins its bow a little earlier or later and is a little wider or closer.
function bow(x, [along, beside], drive) {
  const width = 1.7 + 0.15 * Math.sin(2.1 * drive);
  const berth = BERTH + 0.06 * Math.sin(3.7 * drive + 1);
  return (beside - berth) * Math.exp(-(((x - along) / width) ** 4));
}

session.select("empty");
while (drives.kept.length < Number(count)) {
  const { episode, seed } = session;
  while (!episode.ending) {
    // The way from the start to the goal lies along x.
    const { x } = episode.body;
    const to = Math.min(x + AHEAD, episode.goal[0]);
    hand.target = [to, to < episode.goal[0] ? bow(to, episode.human, seed) : episode.goal[1]];
    session.step();
    drives.add(episode);
  }
  console.error(`seed ${seed}: ${drives.finish(episode)}`);
  hand.release();
  session.next();
}
process.stdout.write(drives.csv);
