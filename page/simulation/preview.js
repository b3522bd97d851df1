// Where the robot would go from here.
import { Episode } from "./episode.js";

/**
 * Points [x, y] of an episode that goes on under one preference, and how it ends.
 *
 * `moment` is that of an episode. After `steps` control steps the ending is still null.
 */
export function preview(moment, policy, preference, { steps = 150, clamped = false } = {}) {
  const ahead = Episode.from(moment);
  const points = [[ahead.body.x, ahead.body.y]];
  for (let step = 0; step < steps && ahead.ending === null; step++) {
    ahead.step(policy.command(ahead.sense(), preference, { clamped }));
    points.push([ahead.body.x, ahead.body.y]);
  }
  return { points, ending: ahead.ending };
}
