// Colours of the objectives, and of preferences between them.

/** Red, green and blue, 0 to 255, of a hex code. */
export function rgb(hex) {
  return [1, 3, 5].map((place) => parseInt(hex.slice(place, place + 2), 16));
}

export function css([red, green, blue], alpha = 1) {
  return `rgba(${Math.round(red)}, ${Math.round(green)}, ${Math.round(blue)}, ${alpha})`;
}

/** The mixture that figures and films use: recipes.objectives.preference_colors. */
export function mixture(preference, corners) {
  return [0, 1, 2].map((channel) =>
    preference.reduce((sum, weight, entry) => sum + weight * corners[entry][channel], 0),
  );
}

/** On a dark floor the same colours, a third of the way to white. */
export function onDark(color) {
  return color.map((value) => value + 0.36 * (255 - value));
}

// What tells objectives apart where colours do not: a pattern of dashes and a mark.
export const DASHES = [[1, 7], [9, 6], [2, 6, 10, 6], [14, 5]];
export const MARKS = ["circle", "square", "triangle", "diamond"];
