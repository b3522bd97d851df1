// The demonstrated path: CircleDemonstrator of envs/demonstrations/drivers.py, as if there were no boxes.
import { CONTROL_PERIOD } from "./drive.js";
import { Episode } from "./episode.js";
import { polar, wrapAngle } from "./geometry.js";

// Turn rate per radian that the robot heads off: four fifths of it are gone a step later.
const GAIN = 0.8 / CONTROL_PERIOD;

/** The command [m/s, rad/s] of the demonstrator { radius, side, speed } for polar goal and human. */
export function circleCommand(goal, human, { radius, side, speed }) {
  const mirror = side === "left" ? 1 : -1;
  const [goalDistance, goalBearing] = [goal[0], mirror * goal[1]];
  const [humanDistance, humanBearing] = [human[0], mirror * human[1]];
  const hx = humanDistance * Math.cos(humanBearing);
  const hy = humanDistance * Math.sin(humanBearing);
  const gx = goalDistance * Math.cos(goalBearing);
  const gy = goalDistance * Math.sin(goalBearing);
  // Angle from human->goal to human->robot: pi before the human, falling to 0 on the orbit.
  let phase = wrapAngle(Math.atan2(-hy, -hx) - Math.atan2(gy - hy, gx - hx));
  if (phase < -Math.PI / 2) phase += 2 * Math.PI;
  const leaving = phase <= 0.1;
  const orbiting = !leaving && humanDistance <= radius + 0.1;
  const inwards = Math.min(Math.max(2 * (humanDistance - radius), -0.6), 0.6);
  const tangent = wrapAngle(humanBearing + Math.PI / 2 - inwards);
  const heading = leaving ? goalBearing : orbiting ? tangent : humanBearing;
  const forward = speed * Math.max(Math.cos(heading), 0) ** 2;
  const turn = GAIN * heading + (orbiting ? -forward / radius : 0);
  return [forward, mirror * turn];
}

/** Where the demonstrator drives in a scene: points [x, y], one a control step, the start first. */
export function demonstratedPath(scene, robot, demonstrator, limits) {
  const episode = new Episode({ ...scene, boxes: [] }, robot, limits);
  const points = [[episode.body.x, episode.body.y]];
  while (episode.ending === null) {
    const goal = polar(episode.body, ...episode.goal);
    const human = polar(episode.body, episode.human[0], episode.human[1]);
    episode.step(circleCommand(goal, human, demonstrator));
    points.push([episode.body.x, episode.body.y]);
  }
  return points;
}
