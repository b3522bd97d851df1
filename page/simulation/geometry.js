// Angles, and points seen from a robot.

/** An angle in (-pi, pi]. */
export function wrapAngle(angle) {
  const wrapped = angle - 2 * Math.PI * Math.floor((angle + Math.PI) / (2 * Math.PI));
  return wrapped === -Math.PI ? Math.PI : wrapped;
}

/** Metres ahead of a body, and to its left. */
export function aheadAndLeft(body, x, y) {
  const cos = Math.cos(body.heading);
  const sin = Math.sin(body.heading);
  const dx = x - body.x;
  const dy = y - body.y;
  return [cos * dx + sin * dy, cos * dy - sin * dx];
}

/** Distance and bearing from a body, as NavigationEnv gives them: in single precision. */
export function polar(body, x, y) {
  const [ahead, left] = aheadAndLeft(body, x, y);
  return [
    Math.fround(Math.hypot(x - body.x, y - body.y)),
    Math.fround(Math.atan2(left, ahead)),
  ];
}

/** From a point to the nearest one of a box [x, y, yaw, half length, half width]; 0 inside. */
export function boxDistance(x, y, box) {
  const cos = Math.cos(box[2]);
  const sin = Math.sin(box[2]);
  const dx = box[0] - x;
  const dy = box[1] - y;
  const along = Math.max(Math.abs(cos * dx + sin * dy) - box[3], 0);
  const across = Math.max(Math.abs(cos * dy - sin * dx) - box[4], 0);
  return Math.hypot(along, across);
}
