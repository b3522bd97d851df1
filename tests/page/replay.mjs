// Runs the page's simulation on episodes that NavigationEnv has driven, or its policy on inputs: JSON in, JSON out.
//   node replay.mjs JOB.json < nothing > RESULT.json
import { readFileSync } from "node:fs";

import { demonstratedPath } from "../../page/simulation/demonstration.js";
import { Episode } from "../../page/simulation/episode.js";
import { Frechet } from "../../page/simulation/frechet.js";
import { Policy } from "../../page/simulation/policy.js";

const job = JSON.parse(readFileSync(process.argv[2], "utf8"));
const policy = new Policy(job.policy, new Uint8Array(readFileSync(job.weights)), job.robot);

function closedLoop({ scene, preference }) {
  const episode = new Episode(scene, job.robot, job.limits);
  const steps = [];
  while (episode.ending === null) {
    const sensed = episode.sense();
    const observation = policy.observation(sensed);
    const action = policy.action(observation, preference);
    episode.step(policy.physical(action));
    const scan = Array.from(sensed.scan);
    steps.push({ scan, observation, action, pose: episode.pose, human: [...episode.human] });
  }
  return { steps, ending: episode.ending };
}

function act({ scan, goal, human, humanVelocity, preference }) {
  return policy.command({ scan: Float32Array.from(scan), goal, human, humanVelocity }, preference, {
    clamped: true,
  });
}

function shown({ scene, path }) {
  const points = demonstratedPath(scene, job.robot, job.demonstrator, job.limits);
  const frechet = new Frechet(points);
  const soFar = path.map(([x, y]) => {
    frechet.add(x, y);
    return frechet.soFar;
  });
  return { points, distance: frechet.distance, soFar };
}

console.log(
  JSON.stringify({
    episodes: (job.episodes ?? []).map(closedLoop),
    commands: (job.inputs ?? []).map(act),
    shown: (job.shown ?? []).map(shown),
  }),
);
