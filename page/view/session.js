// What is going on: a scene, a policy, a preference and an episode. Knows no document.
import { demonstratedPath } from "../simulation/demonstration.js";
import { CONTROL_PERIOD } from "../simulation/drive.js";
import { Episode, HUMAN_RADIUS } from "../simulation/episode.js";
import { Frechet } from "../simulation/frechet.js";
import { readPolicies } from "../simulation/policy.js";

const WALKING_SPEED = 0.5;
const CROSSING = 2.5; // metres to either side
const MOST_GHOSTS = 6;

export class Session {
  constructor(contents) {
    this.contents = contents;
    this.policies = readPolicies(contents.policies, contents.robot);
    this.policyName = Object.keys(contents.policies)[0];
    this.preference = this.policy.tunable.map(() => 1 / this.policy.tunable.length);
    this.playing = true;
    /** Simulated seconds in one. */
    this.pace = 1;
    /** A function of the episode that gives the command in place of the policy, or null while it waits. */
    this.driver = null;
    /** Called after each control step and at each restart. */
    this.onStep = () => {};
    this.onRestart = () => {};
    this.select(Object.keys(contents.scenes)[0]);
  }

  get policy() {
    return this.policies[this.policyName];
  }

  get entry() {
    return this.contents.policies[this.policyName];
  }

  get limits() {
    const { goal_radius: goalRadius, sensing } = this.entry;
    return { goalRadius, maxRange: sensing.max_range, maxSteps: 300 };
  }

  /** Seeds that a scene has, first and last. */
  seeds(name = this.sceneName) {
    const { first_seed: first, scenes } = this.contents.scenes[name];
    return [first, first + scenes.length - 1];
  }

  /** Another scene. Whoever walks there is best met by a policy that knows people who walk. */
  select(name, seed) {
    const [first, last] = this.seeds(name);
    const scene = this.contents.scenes[name];
    this.sceneName = name;
    this.seed = Math.min(Math.max(seed ?? first, first), last);
    this.original = scene.scenes[this.seed - first];
    this.moved = {};
    this.#takeMotion(scene.human_speed > 0 ? "walks" : "stands");
    this.restart();
  }

  /** The scene after the present one, around the end to the first; of another kind where there is one alone. */
  next() {
    const [first, last] = this.seeds();
    if (first < last) this.select(this.sceneName, this.seed < last ? this.seed + 1 : first);
    else {
      const names = Object.keys(this.contents.scenes);
      this.select(names[(names.indexOf(this.sceneName) + 1) % names.length]);
    }
  }

  /** "stands", "walks" or "crosses". The policy follows. */
  setMotion(motion) {
    this.#takeMotion(motion);
    Object.assign(this.episode, this.#walk(this.episode.human));
    this.#edited();
  }

  setPolicy(name) {
    this.#use(name);
    this.#edited();
  }

  /**
   * Put "human", "goal" or "box0" to a place, in this episode and in those after it; a person who would
   * touch the robot beside it.
   */
  move(name, ...place) {
    const [x, y] = name === "human" ? this.#standable(...place) : place;
    this.moved[name] = [x, y];
    const { episode } = this;
    if (name === "goal") episode.goal = [x, y];
    else if (name === "human") {
      [episode.human[0], episode.human[1]] = [x, y];
      Object.assign(episode, this.#walk(episode.human));
    } else {
      const box = episode.boxes[Number(name.slice(3))];
      if (!box) delete this.moved[name];
      else [box[0], box[1]] = [x, y];
    }
    this.#edited();
  }

  /** What is at hand: names that `move` takes. */
  get movable() {
    return ["human", "goal", ...this.original.boxes.map((_, index) => `box${index}`)];
  }

  /** The scene as it starts, with everything where it was put. */
  get scene() {
    const { original, moved } = this;
    const human = [...(moved.human ?? original.human.slice(0, 2)), original.human[2]];
    const boxes = original.boxes.map((box, index) => [
      ...(moved[`box${index}`] ?? box.slice(0, 2)),
      ...box.slice(2),
    ]);
    const scene = { start: original.start, goal: moved.goal ?? original.goal, human, boxes };
    const { humanGoal, humanFrom, humanSpeed, humanReturns } = this.#walk(human);
    // Who crosses begins at one end.
    const from = this.motion === "crosses" ? [...humanFrom, human[2]] : human;
    return {
      ...scene,
      human: from,
      human_goal: humanGoal,
      human_speed: humanSpeed,
      human_returns: humanReturns,
    };
  }

  /** Whether distances may lie beyond those of the training: see Policy.observation. */
  get clamped() {
    return Object.keys(this.moved).length > 0 || this.motion === "crosses";
  }

  restart() {
    if (this.ghostsOf !== this.#place()) this.ghosts = [];
    else if (this.trail.length > 8) this.ghosts = [...this.ghosts, this.trail].slice(-MOST_GHOSTS);
    this.ghostsOf = this.#place();
    this.episode = new Episode(this.scene, this.contents.robot, this.limits);
    const { x, y } = this.episode.body;
    this.trail = [{ x, y, preference: this.driver ? null : this.preference }];
    this.points = [[x, y]];
    this.poses = [[x, y, this.episode.body.heading]];
    this.humanTrack = [[...this.episode.human], [...this.episode.human]];
    this.fraction = 1;
    this.nearest = this.episode.humanDistance;
    this.#measureStyle();
    this.onRestart();
  }

  /** Go on for some seconds of the clock on the wall. */
  tick(seconds) {
    if (!this.playing) return;
    this.fraction += (seconds * this.pace) / CONTROL_PERIOD;
    while (this.fraction >= 1) {
      // At the end, or where the driver waits, this moment stays.
      if (this.episode.ending || !this.step()) {
        this.fraction = 1;
        return;
      }
      this.fraction -= 1;
    }
  }

  /** Whether the episode has ended and its last step has been seen. */
  get over() {
    return this.episode.ending !== null && this.fraction >= 1;
  }

  /** One control step; false where the driver waits. */
  step() {
    const { episode } = this;
    const sensed = episode.sense();
    this.scan = sensed.scan;
    const command = this.driver
      ? this.driver(episode)
      : this.policy.command(sensed, this.preference, { clamped: this.clamped });
    if (command === null) return false;
    const { x, y, heading } = episode.body;
    const human = [...episode.human];
    this.poses = [[x, y, heading], ...episode.step(command)];
    this.humanTrack = [human, [...episode.human]];
    // A preference is never changed, only replaced; null where somebody else drives.
    const preference = this.driver ? null : this.preference;
    for (const pose of this.poses.slice(1)) this.trail.push({ x: pose[0], y: pose[1], preference });
    this.points.push([episode.body.x, episode.body.y]);
    this.frechet?.add(episode.body.x, episode.body.y);
    this.nearest = Math.min(this.nearest, episode.humanDistance);
    this.onStep();
    return true;
  }

  /** Where robot and human are right now, between two control steps. */
  get shown() {
    const along = Math.min(Math.max(this.fraction, 0), 1) * (this.poses.length - 1);
    const before = Math.min(Math.floor(along), Math.max(this.poses.length - 2, 0));
    const after = Math.min(before + 1, this.poses.length - 1);
    const blend = (a, b, share) => a.map((value, entry) => value + share * (b[entry] - value));
    const pose = blend(this.poses[before], this.poses[after], along - before);
    // A person who is dragged is where the hand is.
    const [from, to] = this.humanTrack;
    const walked = to[0] === this.episode.human[0] && to[1] === this.episode.human[1];
    const share = Math.min(Math.max(this.fraction, 0), 1);
    return { pose, human: walked ? blend(from, to, share) : this.episode.human };
  }

  /** Simulated, of this episode. */
  get seconds() {
    return this.episode.elapsed * CONTROL_PERIOD;
  }

  /** Metres to the demonstrated path, so far and at the goal; NaN where nothing is demonstrated. */
  get styleDistance() {
    if (!this.frechet) return NaN;
    return this.episode.ending === "goal" ? this.frechet.distance : this.frechet.soFar;
  }

  // The place, or the nearest one to it where a person does not touch the robot.
  #standable(x, y) {
    const { body } = this.episode;
    const room = this.contents.robot.radius + HUMAN_RADIUS + 0.05;
    const [dx, dy] = [x - body.x, y - body.y];
    const distance = Math.hypot(dx, dy);
    if (distance >= room) return [x, y];
    const way = distance ? Math.atan2(dy, dx) : body.heading;
    return [body.x + room * Math.cos(way), body.y + room * Math.sin(way)];
  }

  #takeMotion(motion) {
    this.motion = motion;
    const walking = motion !== "stands";
    // Null: it knows both, people who stand and people who walk.
    const fits = (one) => one.walking === null || one.walking === walking;
    const found = Object.entries(this.contents.policies).find(([, one]) => fits(one));
    if (found && !fits(this.entry)) this.#use(found[0]);
  }

  // A preference is for the objectives of its policy.
  #use(name) {
    const before = this.policy.tunable;
    this.policyName = name;
    const { tunable } = this.policy;
    if (before.join() !== tunable.join()) this.preference = tunable.map(() => 1 / tunable.length);
  }

  #walk(human) {
    const { original, motion } = this;
    const [x, y] = human;
    if (motion === "stands") {
      return { humanGoal: [x, y], humanFrom: [x, y], humanSpeed: 0, humanReturns: false };
    }
    const speed = this.contents.scenes[this.sceneName].human_speed || WALKING_SPEED;
    if (motion === "walks") {
      const own = this.contents.scenes[this.sceneName].human_speed > 0;
      const humanGoal = own ? [...original.human_goal] : original.start.slice(0, 2);
      return { humanGoal, humanFrom: [x, y], humanSpeed: speed, humanReturns: false };
    }
    const goal = this.moved.goal ?? original.goal;
    const way = Math.atan2(goal[1] - original.start[1], goal[0] - original.start[0]);
    const [across, along] = [-Math.sin(way) * CROSSING, Math.cos(way) * CROSSING];
    return {
      humanGoal: [x + across, y + along],
      humanFrom: [x - across, y - along],
      humanSpeed: speed,
      humanReturns: true,
    };
  }

  #place() {
    return JSON.stringify([this.sceneName, this.seed, this.moved, this.motion]);
  }

  #edited() {
    this.ghosts = [];
    this.ghostsOf = this.#place();
    this.#measureStyle();
  }

  #measureStyle() {
    const { demonstrator } = this.entry;
    this.demonstration = demonstrator
      ? demonstratedPath(this.scene, this.contents.robot, demonstrator, this.limits)
      : null;
    this.frechet = this.demonstration && new Frechet(this.demonstration);
    for (const [x, y] of this.frechet ? this.points : []) this.frechet.add(x, y);
  }
}
