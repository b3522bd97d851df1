// One drive, drawn: the way it took, and the robot on it.
import { CONTROL_PERIOD } from "../simulation/drive.js";
import { onDark, rgb, css } from "../view/colors.js";
import { circle, drawLine } from "../view/shapes.js";
import { drawBox, drawGoal, drawHuman, drawRing, drawRobot } from "../view/things.js";

/** Left and right, as in the pictures of recipes.choices: blue and vermilion, which no colour blindness confuses. */
const SIDES = ["#0072b2", "#d55e00"];
const EVERY = 2; // seconds, between two dots
const MARGIN = 0.6; // metres
const LEAST_HEIGHT = 4.4; // metres
const PERSONAL_SPACE = 2; // metres

export class Picture {
  /** `side`: 0 or 1. `robot`: of the page. */
  constructor(canvas, side, robot) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.side = side;
    this.robot = robot;
    /** Nothing here can be taken hold of. */
    this.selected = null;
  }

  /** Show a drive of a scene; `points` [x, y] are seen in any case, so that two pictures have one scale. */
  take(scene, drive, points, goalRadius) {
    this.scene = scene;
    this.drive = drive;
    const seen = [...points, scene.goal, scene.human, ...(scene.human_speed ? [scene.human_goal] : [])];
    const xs = seen.map(([x]) => x);
    const ys = seen.map(([, y]) => y);
    this.low = [Math.min(...xs) - MARGIN, Math.min(...ys) - MARGIN];
    this.high = [Math.max(...xs) + MARGIN, Math.max(...ys) + MARGIN];
    // What things are drawn with reads these of a session.
    this.session = {
      contents: { robot: this.robot },
      driver: null,
      preference: [1],
      episode: { limits: { goalRadius }, humanGoal: scene.human_goal, humanSpeed: scene.human_speed },
    };
    this.fit();
  }

  /** Take the size of the canvas. */
  fit() {
    const frame = this.canvas.getBoundingClientRect();
    this.ratio = Math.min(window.devicePixelRatio || 1, 2);
    [this.width, this.height] = [frame.width, frame.height];
    this.canvas.width = Math.round(frame.width * this.ratio);
    this.canvas.height = Math.round(frame.height * this.ratio);
    if (!this.drive) return;
    const size = [this.high[0] - this.low[0], Math.max(this.high[1] - this.low[1], LEAST_HEIGHT)];
    this.scale = Math.min(this.width / size[0], this.height / size[1]);
    this.middle = [(this.low[0] + this.high[0]) / 2, (this.low[1] + this.high[1]) / 2];
  }

  /** Pixels of a point in metres. */
  at([x, y]) {
    return [
      this.width / 2 + this.scale * (x - this.middle[0]),
      this.height / 2 - this.scale * (y - this.middle[1]),
    ];
  }

  /** The robot where it is after some seconds. */
  draw(theme, seconds) {
    const { context: c, scene, drive, ratio } = this;
    if (!drive || !this.width) return;
    const color = theme.dark ? onDark(rgb(SIDES[this.side])) : rgb(SIDES[this.side]);
    this.theme = { ...theme, corners: [color] };
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = theme.floor;
    c.fillRect(0, 0, this.width, this.height);
    c.lineCap = c.lineJoin = "round";
    const last = drive.poses.length - 1;
    const step = Math.min(seconds / CONTROL_PERIOD, last);
    const before = Math.floor(step);
    const after = Math.min(before + 1, last);
    const between = (values) =>
      values[before].map((value, entry) => value + (step - before) * (values[after][entry] - value));
    const human = between(drive.humans);
    drawRing(this, human, PERSONAL_SPACE);
    drawGoal(this, scene.goal);
    scene.boxes.forEach((box) => drawBox(this, box));
    if (drive.demonstration) drawLine(this, drive.demonstration, theme.ink, 2, [8, 6], 0.5);
    const way = drive.poses.slice(0, before + 1);
    drawLine(this, drive.poses, css(color), 2.5, [], 0.35);
    drawLine(this, way, css(color), 4.5);
    const every = Math.round(EVERY / CONTROL_PERIOD);
    c.fillStyle = css(color);
    for (let place = 0; place <= last; place += every) {
      circle(c, ...this.at(drive.poses[place]), 4.5);
      c.fill();
    }
    drawHuman(this, human);
    const pose = between(drive.poses);
    // Headings are not mixed: they may lie on both sides of pi.
    drawRobot(this, [pose[0], pose[1], drive.poses[before][2]]);
  }
}
