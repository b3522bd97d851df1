// What stands on the floor, and what the robot sees of it. Each is drawn on a Floor.
import { HUMAN_RADIUS } from "../simulation/episode.js";
import { NUM_RAYS } from "../simulation/lidar.js";
import { css, mixture } from "./colors.js";
import { circle, drawLine, trace } from "./shapes.js";

export function drawRing(floor, place, radius) {
  const { context: c, theme } = floor;
  const [x, y] = floor.at(place);
  c.fillStyle = theme.faint;
  circle(c, x, y, radius * floor.scale);
  c.fill();
  c.fillStyle = theme.quiet;
  c.font = "12px system-ui, sans-serif";
  c.textAlign = "center";
  c.fillText(`${radius} m`, x, y + radius * floor.scale - 7);
  c.textAlign = "start";
}

export function drawLidar(floor) {
  const { context: c, theme, session } = floor;
  const { body, robot } = session.episode;
  const origin = [
    body.x + robot.lidar_offset * Math.cos(body.heading),
    body.y + robot.lidar_offset * Math.sin(body.heading),
  ];
  const seen = [];
  for (let ray = 0; ray < NUM_RAYS; ray += 2) {
    const angle = body.heading + (2 * Math.PI * ray) / NUM_RAYS;
    const range = session.scan[ray];
    seen.push(floor.at([origin[0] + range * Math.cos(angle), origin[1] + range * Math.sin(angle)]));
  }
  trace(c, seen);
  c.closePath();
  c.fillStyle = theme.lidar;
  c.fill();
  c.strokeStyle = theme.lidarEdge;
  c.lineWidth = 1;
  c.stroke();
}

/** Height of the flag, pixels. */
export function poleOf({ scale }) {
  return Math.max(0.62 * scale, 30);
}

export function drawGoal(floor, place) {
  const { context: c, theme, session } = floor;
  const [x, y] = floor.at(place);
  const r = session.episode.limits.goalRadius * floor.scale;
  c.fillStyle = theme.goal;
  circle(c, x, y, r);
  c.fill();
  c.strokeStyle = theme.ink;
  c.lineWidth = 1.5;
  c.setLineDash([4, 4]);
  c.stroke();
  c.setLineDash([]);
  const pole = poleOf(floor);
  c.lineWidth = 2.5;
  trace(c, [[x, y], [x, y - pole]]);
  c.stroke();
  c.fillStyle = theme.ink;
  trace(c, [[x, y - pole], [x + 0.55 * pole, y - 0.8 * pole], [x, y - 0.6 * pole]]);
  c.fill();
  held(floor, "goal", x, y, r);
}

export function drawBox(floor, box, name) {
  const { context: c, theme } = floor;
  const [x, y] = floor.at(box);
  c.save();
  c.translate(x, y);
  c.rotate(-box[2]);
  const [w, h] = [box[3] * floor.scale, box[4] * floor.scale];
  c.fillStyle = theme.box;
  c.strokeStyle = theme.boxEdge;
  c.lineWidth = 1.5;
  c.beginPath();
  c.roundRect(-w, -h, 2 * w, 2 * h, Math.min(5, w, h));
  c.fill();
  c.stroke();
  c.restore();
  held(floor, name, x, y, Math.hypot(box[3], box[4]) * floor.scale);
}

export function drawHuman(floor, place) {
  const { context: c, theme, session } = floor;
  const [x, y] = floor.at(place);
  const r = HUMAN_RADIUS * floor.scale;
  const [gx, gy] = session.episode.humanGoal;
  const walks = session.episode.humanSpeed > 0 && Math.hypot(gx - place[0], gy - place[1]) > 0.05;
  const heading = walks ? Math.atan2(gy - place[1], gx - place[0]) : (place[2] ?? 0);
  if (walks) drawLine(floor, [place, [gx, gy]], theme.ink, 1.2, [2, 6], 0.6);
  c.fillStyle = theme.human;
  c.globalAlpha = 0.22;
  circle(c, x, y, r);
  c.fill();
  c.globalAlpha = 1;
  c.save();
  c.translate(x, y);
  c.rotate(-heading);
  c.beginPath(); // shoulders
  c.ellipse(0, 0, 0.5 * r, 0.98 * r, 0, 0, 2 * Math.PI);
  c.fill();
  c.fillStyle = theme.head;
  c.strokeStyle = theme.human;
  c.lineWidth = 1.5;
  trace(c, [[0.46 * r, 0.2 * r], [0.74 * r, 0], [0.46 * r, -0.2 * r]]); // a nose
  c.arc(0, 0, 0.5 * r, -0.4, 0.4, true);
  c.closePath();
  c.fill();
  c.stroke();
  c.restore();
  held(floor, "human", x, y, r);
  c.font = "12px system-ui, sans-serif";
  c.textAlign = "center";
  c.fillStyle = theme.quiet;
  c.fillText("person", x, y + r + 16);
  c.textAlign = "start";
}

function held(floor, name, x, y, radius) {
  if (floor.selected !== name) return;
  const { context: c, theme } = floor;
  c.strokeStyle = theme.focus;
  c.lineWidth = 2.5;
  circle(c, x, y, radius + 7);
  c.stroke();
}

export function drawRobot(floor, [px, py, heading]) {
  const { context: c, theme, session } = floor;
  const [x, y] = floor.at([px, py]);
  const r = Math.max(session.contents.robot.radius * floor.scale, 9);
  c.save();
  c.translate(x, y);
  c.rotate(-heading);
  // Whoever drives by hand follows no preference.
  c.fillStyle = session.driver ? theme.quiet : css(mixture(session.preference, theme.corners));
  c.strokeStyle = theme.floor;
  c.lineWidth = 3;
  circle(c, 0, 0, r + 4);
  c.stroke();
  c.fill();
  c.fillStyle = theme.robot;
  circle(c, 0, 0, 0.86 * r);
  c.fill();
  c.fillStyle = theme.nose;
  trace(c, [[0.72 * r, 0], [-0.3 * r, 0.5 * r], [-0.08 * r, 0], [-0.3 * r, -0.5 * r]]);
  c.closePath();
  c.fill();
  c.restore();
}

export function drawTarget(floor) {
  const { context: c, theme } = floor;
  const [x, y] = floor.at(floor.target);
  c.strokeStyle = theme.focus;
  c.lineWidth = 2;
  circle(c, x, y, 11);
  c.moveTo(x - 16, y);
  c.lineTo(x + 16, y);
  c.moveTo(x, y - 16);
  c.lineTo(x, y + 16);
  c.stroke();
}
