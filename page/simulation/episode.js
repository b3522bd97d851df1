// An episode of envs/navigation.py: where everything is, what is sensed, how it ends.
import { CONTROL_PERIOD, SUBSTEPS, TIME_STEP, advance, standing } from "./drive.js";
import { boxDistance, polar, wrapAngle } from "./geometry.js";
import { scan } from "./lidar.js";

export const HUMAN_RADIUS = 0.25;

// Last commands that a policy may read: torchrl_morl/deploy/onnx_runner.py.
const NUM_COMMANDS = 4;

// Somebody who is put elsewhere by hand is seen for the first time there, as PolicyRunner has it.
const FASTEST_HUMAN = 3;

/**
 * A robot on its way.
 *
 * `scene` has start [3], goal [2], human [3], human_goal [2], boxes [B][5], human_speed and, where the human
 * goes back and forth, human_returns. Nothing of it is changed.
 */
export class Episode {
  constructor(scene, robot, { goalRadius = 0.3, maxRange = 4, maxSteps = 300 } = {}) {
    this.robot = robot;
    this.limits = { goalRadius, maxRange, maxSteps };
    this.body = standing(scene.start);
    this.goal = [...scene.goal];
    this.human = [...scene.human];
    this.humanGoal = [...scene.human_goal];
    this.humanFrom = [scene.human[0], scene.human[1]];
    this.humanSpeed = scene.human_speed ?? 0;
    this.humanReturns = scene.human_returns ?? false;
    this.boxes = scene.boxes.map((box) => [...box]);
    this.humanBefore = null;
    /** Before the last step, and the commands that the robot was given, the latest first. */
    this.poseBefore = null;
    this.commands = Array.from({ length: NUM_COMMANDS }, () => [0, 0]);
    this.elapsed = 0;
    /** "goal", "human", "box" or "time"; null on the way. */
    this.ending = null;
  }

  /** The episode at the moment of a `moment()`, which may have come from another thread. */
  static from(moment) {
    const scene = { start: [0, 0, 0], goal: [], human: [], human_goal: [], boxes: [] };
    return Object.assign(new Episode(scene, moment.robot), structuredClone(moment));
  }

  /** Everything about this moment, as plain data. */
  moment() {
    return structuredClone({ ...this });
  }

  /** The pose [x, y, heading in (-pi, pi]]. */
  get pose() {
    return [this.body.x, this.body.y, wrapAngle(this.body.heading)];
  }

  /** Between the centres. */
  get humanDistance() {
    return Math.hypot(this.human[0] - this.body.x, this.human[1] - this.body.y);
  }

  /**
   * What the robot senses: lidar, goal and human, how fast the human moves along its axes, and its own motion: speed
   * and turn rate of the last step, and the last commands.
   */
  sense() {
    return {
      scan: scan(
        this.body,
        this.robot,
        [this.human[0], this.human[1], HUMAN_RADIUS],
        this.boxes,
        this.limits.maxRange,
      ),
      goal: polar(this.body, ...this.goal),
      human: polar(this.body, this.human[0], this.human[1]),
      humanVelocity: this.#humanVelocity(),
      motion: [...this.#measured(), ...this.commands.flat()],
    };
  }

  /** A control step under a command [m/s, rad/s]; returns the poses within it. */
  step(command) {
    this.humanBefore = [this.human[0], this.human[1]];
    this.poseBefore = this.pose;
    this.commands = [[...command], ...this.commands.slice(0, -1)];
    const poses = [];
    let touched = null;
    for (let step = 1; step <= SUBSTEPS; step++) {
      if (this.humanSpeed) this.#walk(this.humanSpeed * TIME_STEP);
      advance(this.body, command, this.robot);
      poses.push([this.body.x, this.body.y, this.body.heading]);
      if (step < SUBSTEPS) touched ??= this.#touched();
    }
    this.elapsed++;
    this.ending = this.#end(touched);
    return poses;
  }

  #measured() {
    if (this.poseBefore === null) return [0, 0];
    const [x, y, heading] = this.poseBefore;
    const cos = Math.cos(this.body.heading);
    const sin = Math.sin(this.body.heading);
    const ahead = cos * (this.body.x - x) + sin * (this.body.y - y);
    return [ahead, wrapAngle(this.body.heading - heading)].map((moved) => moved / CONTROL_PERIOD);
  }

  #humanVelocity() {
    if (this.humanBefore === null) return [0, 0];
    const x = (this.human[0] - this.humanBefore[0]) / CONTROL_PERIOD;
    const y = (this.human[1] - this.humanBefore[1]) / CONTROL_PERIOD;
    if (Math.hypot(x, y) > FASTEST_HUMAN) return [0, 0];
    const cos = Math.cos(this.body.heading);
    const sin = Math.sin(this.body.heading);
    return [Math.fround(cos * x + sin * y), Math.fround(cos * y - sin * x)];
  }

  #walk(length) {
    const x = this.humanGoal[0] - this.human[0];
    const y = this.humanGoal[1] - this.human[1];
    const left = Math.hypot(x, y);
    const share = Math.min(left, length) / Math.max(left, 1e-9);
    this.human[0] += x * share;
    this.human[1] += y * share;
    if (this.humanReturns && left <= length) {
      [this.humanGoal, this.humanFrom] = [this.humanFrom, this.humanGoal];
    }
  }

  // "human" or "box" that the robot touches right now, or null.
  #touched() {
    const { x, y } = this.body;
    if (this.humanDistance <= this.robot.radius + HUMAN_RADIUS) return "human";
    return this.boxes.some((box) => boxDistance(x, y, box) <= this.robot.radius) ? "box" : null;
  }

  // How a control step ends that touched something within it, or null.
  #end(before) {
    const { goalRadius, maxSteps } = this.limits;
    const touched = [before, this.#touched()];
    if (touched.includes("human")) return "human";
    if (touched.includes("box")) return "box";
    if (Math.hypot(this.goal[0] - this.body.x, this.goal[1] - this.body.y) <= goalRadius) return "goal";
    return this.elapsed >= maxSteps ? "time" : null;
  }
}
