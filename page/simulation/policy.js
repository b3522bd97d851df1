// A policy of torchrl_morl.deploy: its safetensors, its features and its network.
import { sectors } from "./lidar.js";

/**
 * Tensors of a safetensors file by name: { shape, values }. Only float32, which shipped policies are.
 *
 * https://github.com/huggingface/safetensors#format
 */
export function readSafetensors(file) {
  const size = Number(new DataView(file.buffer, file.byteOffset).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(file.subarray(8, 8 + size)));
  const tensors = {};
  for (const [name, entry] of Object.entries(header)) {
    if (name === "__metadata__") continue;
    if (entry.dtype !== "F32") throw new Error(`${name}: F32 is read alone, got ${entry.dtype}.`);
    const [from, to] = entry.data_offsets;
    // A copy: the file need not be aligned.
    const part = file.slice(8 + size + from, 8 + size + to);
    tensors[name] = { shape: entry.shape, values: new Float32Array(part.buffer) };
  }
  return tensors;
}

/** Linear layers with ReLU between them and tanh behind the last, of a policy's file. */
function readLayers(file) {
  const tensors = readSafetensors(file);
  const names = Object.keys(tensors).filter((name) => /^module\.0\.module\.\d+\.weight$/.test(name));
  const index = (name) => Number(name.split(".")[3]);
  return names
    .sort((a, b) => index(a) - index(b))
    .map((name) => ({
      inputs: tensors[name].shape[1],
      weight: tensors[name].values,
      bias: tensors[name.replace(/weight$/, "bias")].values,
      output: new Float32Array(tensors[name].shape[0]),
    }));
}

// What becomes 1 of a robot's numbers, and how they are called: torchrl_morl/transforms/robot.py.
const ROBOT_SCALES = {
  radius: 0.25,
  max_speed: 1,
  max_turn_rate: Math.PI,
  lidar_fov: 2 * Math.PI,
  lidar_range: 10,
  lidar_offset: 0.25,
};
const SMALLEST_RANGE = 1e-3;

/**
 * `description` is what a policy.json holds beside its card, `file` the bytes of its policy.safetensors, `robot` the one
 * that it drives.
 */
export class Policy {
  constructor(description, file, robot) {
    this.sensing = description.sensing;
    this.robot = robot;
    // Of a policy that knows its robot, actions are shares of that robot's limits.
    this.limits = this.sensing.observe_robot
      ? { speed: [0, robot.max_speed], turn_rate: [-robot.max_turn_rate, robot.max_turn_rate] }
      : description.limits;
    /** Names of the objectives that a preference weighs, in its order. */
    this.tunable = description.objectives.filter((name) => !(name in description.static));
    this.layers = readLayers(file);
  }

  /**
   * What the network reads of what is sensed.
   *
   * With `clamped`, distances beyond those of the training read as the furthest of them, as in
   * `policy.act`; NavigationEnv's episodes need no such thing.
   */
  observation({ scan, goal, human, humanVelocity, motion }, { clamped = false } = {}) {
    const s = this.sensing;
    const near = (distance, furthest) => (clamped ? Math.min(distance, furthest) : distance);
    const out = Array.from(sectors(scan, s.num_sectors), (range, sector) => {
      const free = s.observe_robot ? this.#fromHull(near(range, s.max_range), sector) : range;
      return Math.log(Math.max(free, SMALLEST_RANGE) / s.max_range) / 3;
    });
    const position = ([distance, bearing], scale, furthest) =>
      out.push(near(distance, furthest) / scale, Math.sin(bearing), Math.cos(bearing));
    position(goal, s.goal_scale, s.goal_range[1]);
    if (s.observe_human) position(human, s.human_scale, s.human_range[1]);
    if (s.observe_human_velocity) {
      const unit = s.observe_robot ? this.robot.max_speed : 1;
      out.push(...humanVelocity.map((speed) => speed / unit));
    }
    if (s.observe_nobody) {
      const read = ([distance, bearing]) => [near(distance, s.human_range[1]), bearing].map(Math.fround);
      const nobody = read(s.nobody);
      out.push(read(human).every((value, entry) => value === nobody[entry]) ? 1 : 0);
    }
    if (s.observe_robot) {
      // A lidar that sees further than scans are cut off at reads as one that sees as far.
      const robot = { ...this.robot, lidar_range: Math.min(this.robot.lidar_range, s.max_range) };
      for (const [name, scale] of Object.entries(ROBOT_SCALES)) out.push(robot[name] / scale);
    }
    if (s.observe_motion) {
      const units = s.observe_robot ? [this.robot.max_speed, this.robot.max_turn_rate] : [1, 1];
      out.push(...motion.map((value, entry) => value / units[entry % 2]));
    }
    return out;
  }

  // Along the middle of a sector, from the hull of the robot in place of its lidar.
  #fromHull(range, sector) {
    const angle = (sector + 0.5) * ((2 * Math.PI) / this.sensing.num_sectors);
    const ahead = this.robot.lidar_offset + range * Math.cos(angle);
    return Math.hypot(ahead, range * Math.sin(angle)) - this.robot.radius;
  }

  /** The network alone: an observation and a preference to an action in [-1, 1]. */
  action(observation, preference) {
    let values = Float32Array.from([...observation, ...preference]);
    this.layers.forEach(({ inputs, weight, bias, output }, layer) => {
      const last = layer === this.layers.length - 1;
      for (let row = 0, place = 0; row < output.length; row++) {
        let sum = bias[row];
        for (let column = 0; column < inputs; column++) sum += weight[place++] * values[column];
        output[row] = last ? Math.tanh(sum) : Math.max(sum, 0);
      }
      values = output;
    });
    return [values[0], values[1]];
  }

  /** From what is sensed to a command [m/s, rad/s]. */
  command(sensed, preference, options) {
    return this.physical(this.action(this.observation(sensed, options), preference));
  }

  /** An action in [-1, 1] as a command. */
  physical(action) {
    return [this.limits.speed, this.limits.turn_rate].map(([low, high], entry) =>
      Math.fround((high + low) / 2 + ((high - low) / 2) * action[entry]),
    );
  }
}

/** The bytes of a base64 text. */
export function bytes(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

/** Policies of a page by name, ready to act on its robot; `entries` is what the page holds of them. */
export function readPolicies(entries, robot) {
  const read = ([name, entry]) => [name, new Policy(entry, bytes(entry.weights), robot)];
  return Object.fromEntries(Object.entries(entries).map(read));
}
