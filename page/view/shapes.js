// Lines and circles: what every picture is drawn of.

/** A path through points [x, y] in pixels, to be filled or stroked. */
export function trace(context, points) {
  context.beginPath();
  for (const [x, y] of points) context.lineTo(x, y); // the first one only moves there
}

/** A circle in pixels, to be filled or stroked. */
export function circle(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
}

/** A line through points in metres on a Floor or a Picture. */
export function drawLine(floor, points, color, width, dash = [], alpha = 1) {
  const { context: c } = floor;
  c.save();
  c.globalAlpha = alpha;
  c.strokeStyle = color;
  c.lineWidth = width;
  c.setLineDash(dash);
  trace(c, points.map((point) => floor.at(point)));
  c.stroke();
  c.restore();
}
