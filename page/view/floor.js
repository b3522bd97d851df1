// The floor from above: everything that is drawn.
import { HUMAN_RADIUS } from "../simulation/episode.js";
import { boxDistance } from "../simulation/geometry.js";
import { DASHES, MARKS, css, mixture } from "./colors.js";
import { circle, drawLine, trace } from "./shapes.js";
import { drawBox, drawGoal, drawHuman, drawLidar, drawRing, drawRobot, drawTarget, poleOf } from "./things.js";

const MARGIN = { x: 1.0, y: 0.9 };
const LEAST_HEIGHT = 5.4; // metres
const PERSONAL_SPACE = 2; // metres: closer than this, distance counts
const TOUCH = 22; // pixels around a thing that still take hold of it
const BESIDE = 8; // and beside a box

export class Floor {
  constructor(canvas, session) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.session = session;
    /** What is drawn beside the scene itself. */
    this.show = { previews: true, demonstration: false, lidar: false };
    this.selected = null;
    this.target = null;
  }

  /** Take the size of the canvas, and see the whole scene. */
  fit() {
    const frame = this.canvas.getBoundingClientRect();
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.width = frame.width;
    this.height = frame.height;
    this.canvas.width = Math.round(frame.width * ratio);
    this.canvas.height = Math.round(frame.height * ratio);
    this.ratio = ratio;
    const { start, goal, human, human_goal: humanGoal, boxes } = this.session.scene;
    const points = [start, goal, human, humanGoal];
    // Walls that go on for metres need not be seen to their ends.
    for (const [x, y, , length, width] of boxes) {
      const reach = Math.hypot(length, width);
      if (reach < 1.5) points.push([x - reach, y - reach], [x + reach, y + reach]);
    }
    const xs = points.map((point) => point[0]);
    const ys = points.map((point) => point[1]);
    const low = [Math.min(...xs) - MARGIN.x, Math.min(...ys) - MARGIN.y];
    const high = [Math.max(...xs) + MARGIN.x, Math.max(...ys) + MARGIN.y];
    const middle = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
    const size = [high[0] - low[0], Math.max(high[1] - low[1], LEAST_HEIGHT)];
    // The numbers lie above the scene, not on it.
    this.top = this.width < 520 ? 46 : 56;
    this.scale = Math.min(this.width / size[0], (this.height - this.top) / size[1]);
    this.middle = middle;
  }

  /** Pixels of a point in metres. */
  at([x, y]) {
    return [
      this.width / 2 + this.scale * (x - this.middle[0]),
      (this.height + this.top) / 2 - this.scale * (y - this.middle[1]),
    ];
  }

  /** Metres of a point in pixels, within what is seen. */
  metres(px, py) {
    const edge = 0.2 * this.scale;
    const x = Math.min(Math.max(px, edge), this.width - edge);
    const y = Math.min(Math.max(py, edge), this.height - edge);
    return [
      this.middle[0] + (x - this.width / 2) / this.scale,
      this.middle[1] - (y - (this.height + this.top) / 2) / this.scale,
    ];
  }

  /** The nearest place in metres where a thing, as `move` names it, is seen, and below the numbers. */
  inside(name, place) {
    const [px, py] = this.at(place);
    const above = name === "goal" ? poleOf(this) : 0.2 * this.scale;
    return this.metres(px, Math.max(py, this.top + above));
  }

  /** The movable thing at a point in pixels, or null. */
  thingAt(px, py) {
    const { episode } = this.session;
    const near = (place, radius) => {
      const [x, y] = this.at(place);
      return Math.hypot(px - x, py - y) <= Math.max(radius * this.scale, TOUCH);
    };
    if (near(this.session.shown.human, HUMAN_RADIUS)) return "human";
    if (near(episode.goal, episode.limits.goalRadius)) return "goal";
    const [x, y] = this.metres(px, py);
    const index = episode.boxes.findIndex((box) => boxDistance(x, y, box) <= BESIDE / this.scale);
    return index < 0 ? null : `box${index}`;
  }

  /** Everything, in the colours of `theme`; `previews` has the ways ahead. */
  draw(theme, previews) {
    const { context: c, session, ratio } = this;
    this.theme = theme;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = theme.floor;
    c.fillRect(0, 0, this.width, this.height);
    c.lineCap = c.lineJoin = "round";
    this.#grid();
    const { pose, human } = session.shown;
    if (this.show.lidar && session.scan) drawLidar(this);
    drawRing(this, human, PERSONAL_SPACE);
    drawGoal(this, session.episode.goal);
    session.episode.boxes.forEach((box, index) => drawBox(this, box, `box${index}`));
    if (this.show.demonstration && session.demonstration) {
      drawLine(this, session.demonstration, theme.ink, 2.5, [10, 7], 0.55);
    }
    for (const ghost of session.ghosts) this.#trail(ghost, 0.3);
    this.#trail([...session.trail.slice(0, -4), { x: pose[0], y: pose[1] }], 1);
    if (this.show.previews && !session.driver) this.#previews(previews, pose, human);
    drawHuman(this, human);
    drawRobot(this, pose);
    if (this.target) drawTarget(this);
  }

  #grid() {
    const { context: c, theme } = this;
    const [left, top] = this.at([Math.floor(this.middle[0] - this.width / this.scale), 0]);
    c.strokeStyle = theme.grid;
    c.lineWidth = 1;
    c.beginPath();
    for (let x = left % this.scale; x < this.width; x += this.scale) {
      c.moveTo(x, 0);
      c.lineTo(x, this.height);
    }
    for (let y = top % this.scale; y < this.height; y += this.scale) {
      c.moveTo(0, y);
      c.lineTo(this.width, y);
    }
    c.stroke();
  }

  // Where the robot went, each piece in the colour of the preference under which it went there.
  #trail(trail, alpha) {
    const { theme } = this;
    if (trail.length < 2) return;
    if (alpha === 1) {
      drawLine(this, trail.map(({ x, y }) => [x, y]), theme.casing, 7);
    }
    for (let from = 0; from < trail.length - 1; ) {
      let to = from + 1;
      while (to < trail.length - 1 && trail[to + 1].preference === trail[to].preference) to++;
      const { preference } = trail[from + 1];
      const color = preference ? css(mixture(preference, theme.corners)) : theme.quiet;
      const part = trail.slice(from, to + 1).map(({ x, y }) => [x, y]);
      drawLine(this, part, color, alpha === 1 ? 4.5 : 3, [], alpha);
      from = to;
    }
  }

  #previews(previews, pose, human) {
    const { theme } = this;
    const { ways, names, own } = previews.ahead(this.session.episode.elapsed);
    if (own) {
      const color = css(mixture(this.session.preference, theme.corners));
      drawLine(this, [pose, ...own.slice(2)], color, 9, [], 0.28);
    }
    ways.forEach((points, corner) => {
      const color = css(theme.corners[corner]);
      const ahead = [pose, ...points.slice(2)];
      drawLine(this, ahead, theme.casing, 5, DASHES[corner % DASHES.length], 0.55);
      drawLine(this, ahead, color, 3, DASHES[corner % DASHES.length]);
    });
    names.forEach((place, corner) => {
      const color = css(theme.corners[corner]);
      if (place) this.#mark(...this.at(place), MARKS[corner % MARKS.length], color);
    });
    const [x, y] = this.at(human);
    const word = y + HUMAN_RADIUS * this.scale; // "person", see drawHuman
    const taken = [[0, 0, this.width, this.top], [x - 22, word + 4, x + 22, word + 20]];
    const found = names.filter(Boolean);
    for (const [x, y] of found.map((place) => this.at(place))) {
      taken.push([x - 8, y - 8, x + 8, y + 8]);
    }
    const middle = found.reduce((sum, [, y]) => sum + y / found.length, 0);
    names.forEach((place, corner) => {
      if (place) this.#label(this.labels[corner], this.at(place), place[1] >= middle, taken);
    });
  }

  // Above or below a mark, and on no other label.
  #label(text, [x, y], above, taken) {
    const { context: c, theme } = this;
    c.font = `600 ${this.width < 520 ? 11 : 13}px system-ui, sans-serif`;
    const width = c.measureText(text).width;
    const left = Math.min(Math.max(x - width / 2, 8), this.width - width - 8);
    const lines = [y - 15, y + 25, y - 32, y + 42];
    for (const line of above ? lines : [lines[1], lines[3], lines[0], lines[2]]) {
      const box = [left - 4, line - 13, left + width + 4, line + 4];
      const free = ([l, t, r, b]) => box[2] < l || box[0] > r || box[3] < t || box[1] > b;
      if (!taken.every(free) || box[3] > this.height) continue;
      taken.push(box);
      c.lineWidth = 4;
      c.strokeStyle = theme.floor;
      c.strokeText(text, left, line);
      c.fillStyle = theme.ink;
      c.fillText(text, left, line);
      return;
    }
  }

  #mark(x, y, mark, color) {
    const { context: c, theme } = this;
    const r = 6;
    if (mark === "circle") circle(c, x, y, r);
    else {
      const count = { square: 4, triangle: 3, diamond: 4 }[mark];
      const turn = mark === "square" ? Math.PI / 4 : Math.PI / 2;
      const corners = Array.from({ length: count }, (_, corner) => {
        const angle = turn + (2 * Math.PI * corner) / count;
        return [x + 1.3 * r * Math.cos(angle), y - 1.3 * r * Math.sin(angle)];
      });
      trace(c, corners);
      c.closePath();
    }
    c.fillStyle = color;
    c.strokeStyle = theme.floor;
    c.lineWidth = 4;
    c.stroke();
    c.fill();
  }
}
