// Driving by hand: keys, a pointer on the floor or a gamepad, to commands for the robot.
import { CONTROL_PERIOD } from "../simulation/drive.js";
import { aheadAndLeft } from "../simulation/geometry.js";

const TURN_RATE = 1.4; // rad/s at most by keys and stick
const RAMP = 4.0; // rad/s^2
const DEAD_ZONE = 0.12;

const WAYS = {
  ArrowUp: "ahead",
  KeyW: "ahead",
  ArrowLeft: "left",
  KeyA: "left",
  ArrowRight: "right",
  KeyD: "right",
  ArrowDown: "slow",
  KeyS: "slow",
};

export class Hand {
  constructor() {
    this.held = new Set();
    /** Where the pointer is pressed on the floor, [x, y] in metres, or null. */
    this.target = null;
    /** A function that returns [left to right, up to down] of a stick, or null. */
    this.stick = () => null;
    this.turnRate = 0;
  }

  /** A key goes down or up; whether it drives. */
  key(code, down) {
    const way = WAYS[code];
    if (!way) return false;
    if (down) this.held.add(way);
    else this.held.delete(way);
    return true;
  }

  release() {
    this.held.clear();
    this.target = null;
    this.turnRate = 0;
  }

  /** The command [m/s, rad/s] for a body, or null where nothing is held. */
  command(body, robot) {
    if (this.target) return this.#follow(body, robot);
    const stick = this.stick();
    const tilted = stick && Math.hypot(...stick) > DEAD_ZONE;
    if (!tilted && !this.held.size) {
      this.turnRate = 0;
      return null;
    }
    const [sideways, down] = tilted ? stick : this.#keys();
    const wanted = -sideways * TURN_RATE;
    const most = RAMP * CONTROL_PERIOD;
    this.turnRate += Math.min(Math.max(wanted - this.turnRate, -most), most);
    return [robot.max_speed * Math.min(Math.max(-down, 0), 1), this.turnRate];
  }

  #keys() {
    const { held } = this;
    const sideways = held.has("right") - held.has("left");
    const ahead = held.has("ahead") ? 1 : 0;
    return [sideways, held.has("slow") ? -0.5 * ahead : -ahead];
  }

  // Towards the pointer: slower near it and in corners, as the scripted drivers do.
  #follow(body, robot) {
    const [ahead, left] = aheadAndLeft(body, ...this.target);
    const distance = Math.hypot(ahead, left);
    if (distance < 0.05) return [0, 0];
    const bearing = Math.atan2(left, ahead);
    const speed = robot.max_speed * Math.max(Math.cos(bearing), 0) ** 2 * Math.min(distance / 0.4, 1);
    this.turnRate = Math.min(Math.max(3 * bearing, -2), 2);
    return [speed, this.turnRate];
  }
}
