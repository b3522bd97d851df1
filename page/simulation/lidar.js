// The lidar of envs/lidar.py: ranges to a circle, the human, and to boxes, in closed form.
import { aheadAndLeft } from "./geometry.js";

export const NUM_RAYS = 720;
const MIN_RANGE = 1e-3;
// Added to the circles around obstacles: rounding must not take anything from their edges.
const MARGIN = 1e-6;
const STEP = (2 * Math.PI) / NUM_RAYS;
const COS = Float64Array.from({ length: NUM_RAYS }, (_, ray) => Math.cos(STEP * ray));
const SIN = Float64Array.from({ length: NUM_RAYS }, (_, ray) => Math.sin(STEP * ray));

/**
 * Ranges of a revolution, counter-clockwise from the heading: a Float32Array of 720.
 *
 * `human` is [x, y, radius], each of `boxes` [x, y, yaw, half length, half width].
 */
export function scan(body, robot, human, boxes, maxRange) {
  const ranges = new Float32Array(NUM_RAYS).fill(maxRange);
  const [ahead, left] = aheadAndLeft(body, human[0], human[1]);
  lower(ranges, ahead - robot.lidar_offset, left, human[2], maxRange, (u, v) =>
    circleRange(ahead - robot.lidar_offset, left, u, v, human[2]),
  );
  for (const box of boxes) {
    const [boxAhead, boxLeft] = aheadAndLeft(body, box[0], box[1]);
    const x = boxAhead - robot.lidar_offset;
    const turn = box[2] - body.heading;
    const c = Math.cos(turn);
    const s = Math.sin(turn);
    const along = -(c * x + s * boxLeft);
    const across = s * x - c * boxLeft;
    lower(ranges, x, boxLeft, Math.hypot(box[3], box[4]), maxRange, (u, v) =>
      boxRange(along, across, c * u + s * v, c * v - s * u, box[3], box[4]),
    );
  }
  for (let ray = 0; ray < NUM_RAYS; ray++) {
    const angle = STEP * ray;
    const outside = Math.min(angle, 2 * Math.PI - angle) > robot.lidar_fov / 2 + 1e-9;
    if (outside || ranges[ray] > robot.lidar_range) ranges[ray] = maxRange;
  }
  return ranges;
}

/** The shortest range of each of `count` equal sectors. */
export function sectors(ranges, count) {
  const size = ranges.length / count;
  const out = new Float32Array(count).fill(Infinity);
  ranges.forEach((range, ray) => {
    const sector = Math.floor(ray / size);
    if (range < out[sector]) out[sector] = range;
  });
  return out;
}

// Only the rays between the tangents of a circle around an obstacle can meet it.
function lower(ranges, x, y, radius, maxRange, range) {
  const around = radius + MARGIN;
  const distance = Math.hypot(x, y);
  if (distance > around + maxRange) return;
  let first = 0;
  let last = NUM_RAYS - 1;
  if (distance > around) {
    const middle = Math.atan2(y, x);
    const half = Math.asin(around / distance);
    first = Math.ceil((middle - half) / STEP);
    last = Math.floor((middle + half) / STEP);
  }
  for (let index = first; index <= last; index++) {
    const ray = ((index % NUM_RAYS) + NUM_RAYS) % NUM_RAYS;
    const near = Math.max(range(COS[ray], SIN[ray]), MIN_RANGE);
    if (near < ranges[ray]) ranges[ray] = near;
  }
}

// Along the unit vector (u, v) from the origin to a circle around (x, y).
function circleRange(x, y, u, v, radius) {
  const middle = x * u + y * v;
  const square = middle * middle - (x * x + y * y - radius * radius);
  if (square < 0) return Infinity;
  const half = Math.sqrt(square);
  const near = middle >= half ? middle - half : middle + half;
  return near >= 0 ? near : Infinity;
}

// From (x, y) along the unit vector (u, v), in the frame of the box.
function boxRange(x, y, u, v, halfLength, halfWidth) {
  let near = -Infinity;
  let far = Infinity;
  for (const [start, way, half] of [[x, u, halfLength], [y, v, halfWidth]]) {
    if (way === 0) {
      if (Math.abs(start) > half) return Infinity;
      continue;
    }
    const first = (-half - start) / way;
    const second = (half - start) / way;
    near = Math.max(near, Math.min(first, second));
    far = Math.min(far, Math.max(first, second));
  }
  if (near > far || far < 0) return Infinity;
  return near >= 0 ? near : far; // from inside, where the ray leaves
}
