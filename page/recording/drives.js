// Drives that were recorded, and the files that recipes.import_demonstrations reads: docs/demonstrations.md.
import { CONTROL_PERIOD } from "../simulation/drive.js";

const COLUMNS = "trajectory,time,x,y,heading,human_x,human_y,goal_x,goal_y";
const BOX_COLUMNS = "trajectory,x,y,yaw,half_length,half_width";
const WRONG = {
  human: "it touched the person",
  box: "it touched a box",
  time: "it took longer than a minute",
};

export class Drives {
  constructor() {
    /** Finished ones: { name, points, boxes, seconds, nearest, side }. */
    this.kept = [];
    this.counted = 0;
    this.begin();
  }

  /** Another drive; what was not finished is left out. */
  begin() {
    this.points = [];
  }

  /** Remember where an episode is. Call it at the start and after each control step. */
  add(episode) {
    const [x, y, heading] = episode.pose;
    const [humanX, humanY] = episode.human;
    const time = this.points.length * CONTROL_PERIOD;
    this.points.push([time, x, y, heading, humanX, humanY, ...episode.goal]);
  }

  /** The drive is over: keep it if it came to its goal, and say what became of it. */
  finish(episode) {
    const points = this.points;
    this.begin();
    if (episode.ending !== "goal") return `Not kept: ${WRONG[episode.ending]}.`;
    const away = ([, x, y, , humanX, humanY]) => Math.hypot(x - humanX, y - humanY);
    const nearest = Math.min(...points.map(away));
    const drive = {
      name: `drive ${++this.counted}`,
      points,
      boxes: episode.boxes.map((box) => [...box]),
      seconds: (points.length - 1) * CONTROL_PERIOD,
      nearest,
      side: passes(points),
    };
    this.kept.push(drive);
    const where = `${drive.nearest.toFixed(1)} m from the person, on the ${drive.side}`;
    return `Kept ${drive.name}: ${drive.seconds.toFixed(1)} s, ${where}.`;
  }

  remove(name) {
    this.kept = this.kept.filter((drive) => drive.name !== name);
  }

  get csv() {
    const rows = this.kept.flatMap(({ name, points }) =>
      points.map((point) => [name, ...point.map(short)].join(",")),
    );
    return [COLUMNS, ...rows, ""].join("\n");
  }

  /** The second file, or null where no drive had a box around it. */
  get boxesCsv() {
    const rows = this.kept.flatMap(({ name, boxes }) =>
      boxes.map((box) => [name, ...box.map(short)].join(",")),
    );
    return rows.length ? [BOX_COLUMNS, ...rows, ""].join("\n") : null;
  }
}

// Millimetres would do; a tenth of that leaves nothing to a check of speeds.
function short(value) {
  return String(Number(value.toFixed(4)));
}

// On which side of the person, seen from the start: abreast of them, as recipes.evaluation.style has it.
function passes(points) {
  const [, x0, y0, , , , goalX, goalY] = points[0];
  const way = Math.atan2(goalY - y0, goalX - x0);
  const seen = points.map(([, x, y, , humanX, humanY]) => [
    Math.cos(way) * (x - humanX) + Math.sin(way) * (y - humanY),
    Math.cos(way) * (y - humanY) - Math.sin(way) * (x - humanX),
  ]);
  const abreast = seen.reduce((best, one) => (Math.abs(one[0]) < Math.abs(best[0]) ? one : best));
  return abreast[1] > 0 ? "left" : "right";
}
