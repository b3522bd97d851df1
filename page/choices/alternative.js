// A drive to choose from: the page's own policy under one preference, in one scene.
import { demonstratedPath } from "../simulation/demonstration.js";
import { CONTROL_PERIOD } from "../simulation/drive.js";
import { Episode } from "../simulation/episode.js";
import { Frechet } from "../simulation/frechet.js";

/**
 * Everything that a picture shows: `poses` [x, y, heading] and `humans` [x, y, heading], one a control step, the start first;
 * `ending`; `seconds`, `nearest` (to the person, metres) and `style` (metres to the demonstrated path, NaN without one).
 *
 * @param robot of the page
 * @param policy a `Policy`
 * @param entry what the page holds of it
 */
export function alternative(scene, preference, { robot, policy, entry }) {
  const limits = { goalRadius: entry.goal_radius, maxRange: entry.sensing.max_range, maxSteps: 300 };
  const episode = new Episode(scene, robot, limits);
  const demonstration = entry.demonstrator && demonstratedPath(scene, robot, entry.demonstrator, limits);
  const poses = [episode.pose];
  const humans = [[...episode.human]];
  let nearest = episode.humanDistance;
  while (episode.ending === null) {
    episode.step(policy.command(episode.sense(), preference));
    poses.push(episode.pose);
    humans.push([...episode.human]);
    nearest = Math.min(nearest, episode.humanDistance);
  }
  const frechet = demonstration && new Frechet(demonstration);
  if (frechet) for (const [x, y] of poses) frechet.add(x, y);
  return {
    poses,
    humans,
    ending: episode.ending,
    seconds: episode.elapsed * CONTROL_PERIOD,
    nearest,
    demonstration,
    style: frechet ? frechet.distance : NaN,
  };
}
