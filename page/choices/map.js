// How well every preference is expected to serve a person, as dots in the triangle.
import { css, mixture } from "../view/colors.js";
import { circle, trace } from "../view/shapes.js";

const HEIGHT = Math.sqrt(3) / 2;

/**
 * Draw them, larger where more is expected, and a ring around the chosen one.
 *
 * @param canvas as wide as it is shown, and HEIGHT times as high
 * @param preferences of three objectives, first corner on top, then left, then right
 * @param best a `Dialogue.best`, or null before the first answer
 */
export function drawMap(canvas, preferences, best, theme) {
  const width = canvas.clientWidth;
  if (!width) return;
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const height = width * HEIGHT;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const c = canvas.getContext("2d");
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  const largest = width / 22; // radius of a dot
  const edge = largest + 7;
  const place = ([, left, right]) => [
    edge + (width - 2 * edge) * (0.5 - left / 2 + right / 2),
    edge + (height - 2 * edge) * (left + right),
  ];
  c.strokeStyle = theme.quiet;
  c.globalAlpha = 0.5;
  c.lineJoin = "round";
  trace(c, [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map(place));
  c.closePath();
  c.stroke();
  c.globalAlpha = 1;
  const values = best ? best.satisfaction : preferences.map(() => 0);
  const most = Math.max(...values);
  preferences.forEach((preference, index) => {
    // A fifth less than the best is hardly seen.
    const share = best ? Math.max(1 - (most - values[index]) / 0.3, 0) : 0;
    c.fillStyle = best ? css(mixture(preference, theme.corners)) : theme.quiet;
    c.globalAlpha = 0.35 + 0.65 * share;
    circle(c, ...place(preference), 1.6 + (largest - 1.6) * share);
    c.fill();
  });
  c.globalAlpha = 1;
  if (!best) return;
  c.strokeStyle = theme.ink;
  c.lineWidth = 3;
  circle(c, ...place(preferences[best.index]), largest + 4);
  c.stroke();
}
