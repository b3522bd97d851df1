// The preference as a dot between three corners.
import { css, mixture } from "./colors.js";
import { trace } from "./shapes.js";

const HEIGHT = Math.sqrt(3) / 2;
const STEP = 0.05;

/** The nearest point of the simplex: Wang and Carreira-Perpinan, https://arxiv.org/abs/1309.1541. */
export function onSimplex(weights) {
  const sorted = [...weights].sort((a, b) => b - a);
  let sum = 0;
  let shift = 0;
  sorted.forEach((value, index) => {
    sum += value;
    const candidate = (1 - sum) / (index + 1);
    if (value + candidate > 0) shift = candidate;
  });
  return weights.map((value) => Math.max(value + shift, 0));
}

/** Weights with entry `index` at `value`; the others keep their shares of the rest. */
export function withWeight(weights, index, value) {
  const rest = 1 - weights[index];
  return weights.map((weight, entry) => {
    if (entry === index) return value;
    const share = rest > 1e-9 ? weight / rest : 1 / (weights.length - 1);
    return share * (1 - value);
  });
}

export class Triangle {
  /** `box` holds a canvas and the dot, a slider; `onChange` gets the new weights. */
  constructor(box, { names, onChange }) {
    this.box = box;
    this.canvas = box.querySelector("canvas");
    this.dot = box.querySelector("[role=slider]");
    this.names = names;
    this.onChange = onChange;
    this.weights = [1 / 3, 1 / 3, 1 / 3];
    const follow = (event) => {
      event.preventDefault();
      this.onChange(this.#weightsAt(event));
    };
    box.addEventListener("pointerdown", (event) => {
      box.setPointerCapture(event.pointerId);
      this.dot.focus({ preventScroll: true, focusVisible: false });
      box.addEventListener("pointermove", follow);
      follow(event);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      box.addEventListener(end, () => box.removeEventListener("pointermove", follow));
    }
    this.dot.addEventListener("keydown", (event) => this.#key(event));
  }

  /** Draw the corners' colours, and mixtures of them between. */
  paint(corners) {
    this.corners = corners;
    const width = this.box.clientWidth;
    if (!width) return;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const size = Math.round(width * ratio);
    const height = Math.round(size * HEIGHT);
    this.canvas.width = size;
    this.canvas.height = height;
    const context = this.canvas.getContext("2d");
    const image = context.createImageData(size, height);
    for (let row = 0; row < height; row++) {
      for (let column = 0; column < size; column++) {
        const weights = weightsOf(column / size, row / size);
        if (Math.min(...weights) < -0.02) continue;
        const color = mixture(onSimplex(weights), corners);
        image.data.set([...color, 255], 4 * (row * size + column));
      }
    }
    context.putImageData(image, 0, 0);
    // A clean edge.
    context.globalCompositeOperation = "destination-in";
    trace(context, [[size / 2, 0], [0, height], [size, height]]);
    context.fill();
    this.show(this.weights);
  }

  show(weights) {
    this.weights = weights;
    const [x, y] = placeOf(weights);
    this.dot.style.left = `${100 * x}%`;
    this.dot.style.top = `${(100 * y) / HEIGHT}%`;
    if (this.corners) this.dot.style.background = css(mixture(weights, this.corners));
    const parts = weights.map((weight, entry) => `${this.names[entry]} ${Math.round(100 * weight)} %`);
    this.dot.setAttribute("aria-valuetext", parts.join(", "));
    this.dot.setAttribute("aria-valuenow", Math.round(100 * weights[0]));
  }

  #weightsAt(event) {
    const frame = this.canvas.getBoundingClientRect();
    const x = (event.clientX - frame.left) / frame.width;
    const y = (event.clientY - frame.top) / frame.width;
    const weights = onSimplex(weightsOf(x, y));
    // Corners catch: a preference is seldom meant to be nearly pure.
    const largest = Math.max(...weights);
    return largest > 0.96 ? weights.map((weight) => (weight === largest ? 1 : 0)) : weights;
  }

  #key(event) {
    const ways = {
      ArrowUp: [0, -STEP],
      ArrowDown: [0, STEP],
      ArrowLeft: [-STEP, 0],
      ArrowRight: [STEP, 0],
    };
    if (!(event.key in ways)) return;
    event.preventDefault();
    event.stopPropagation();
    const [x, y] = placeOf(this.weights);
    const [dx, dy] = ways[event.key];
    this.onChange(onSimplex(weightsOf(x + dx, y + dy)));
  }
}

// In units of the width, y down: the first corner on top, then left, then right.
function placeOf([, left, right]) {
  return [0.5 - left / 2 + right / 2, (left + right) * HEIGHT];
}

function weightsOf(x, y) {
  const below = y / HEIGHT;
  return [1 - below, below / 2 - (x - 0.5), below / 2 + (x - 0.5)];
}
