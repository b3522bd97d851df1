// What is known of a person's weights after some choices: PreferencePosterior of torchrl_morl.choices, for one context
// and up to four objectives, where all sums over a grid are exact.

/** What can be said of two alternatives, in the order of probabilities. */
export const ANSWERS = ["first", "second", "tie", "neither"];

/** Points of the simplex whose entries are multiples of 1 / divisions, in lexicographic order; float32, as in torch. */
export function lattice(size, divisions) {
  const rows = (entries, left) => {
    if (entries === 1) return [[left]];
    return Array.from({ length: left + 1 }, (_, first) =>
      rows(entries - 1, left - first).map((rest) => [first, ...rest]),
    ).flat();
  };
  return rows(size, divisions).map((row) => row.map((value) => Math.fround(value / divisions)));
}

/** The product of two vectors. */
export function dot(weights, values) {
  let sum = 0;
  for (let entry = 0; entry < weights.length; entry++) sum += weights[entry] * values[entry];
  return sum;
}

/**
 * Put the probabilities of ANSWERS into `out`, for the utilities of the first and of the second times the
 * rationality. `model`: slip, tie, neither, see `ChoiceModel`.
 */
export function answerChances(first, second, model, out) {
  // Divided by the largest of them, no exponential grows too large.
  const most = Math.max(first, second, 0);
  out[0] = Math.exp(first - most);
  out[1] = Math.exp(second - most);
  out[2] = model.tie * Math.sqrt(out[0] * out[1]);
  out[3] = model.neither * Math.exp(-most);
  const share = (1 - model.slip) / (out[0] + out[1] + out[2] + out[3]);
  const accident = model.slip / (2 + (model.tie > 0) + (model.neither > 0));
  out[0] = out[0] * share + accident;
  out[1] = out[1] * share + accident;
  out[2] = model.tie > 0 ? out[2] * share + accident : 0;
  out[3] = model.neither > 0 ? out[3] * share + accident : 0;
}

export class Posterior {
  /**
   * @param size number of objectives
   * @param model the fields of `ChoiceModel`
   * @param divisions of the grid along an edge
   */
  constructor(size, model, divisions) {
    this.model = model;
    const share = (1 - model.chance) / model.rationalities.length;
    const prior = model.rationalities.map((value) => [value, share]);
    if (model.chance) prior.unshift([0, model.chance]);
    /** Hypotheses: { weights, rationality }. */
    this.hypotheses = lattice(size, divisions).flatMap((weights) =>
      prior.map(([rationality]) => ({ weights, rationality })),
    );
    this.logPrior = this.hypotheses.map((_, index) => Math.log(prior[index % prior.length][1]));
    this.restart();
  }

  /** Take an answer in: outcomes of both alternatives, and one of ANSWERS. */
  answer(first, second, answer) {
    this.choices.push({ first: [...first], second: [...second], answer });
    this.#infer();
  }

  /** Forget all answers. */
  restart() {
    /** Answers, oldest first: { first, second, answer }, outcomes higher is better. */
    this.choices = [];
    this.#infer();
  }

  /** Forget the newest answer. */
  undo() {
    this.choices.pop();
    this.#infer();
  }

  /** Mean of the weights. */
  get mean() {
    return this.hypotheses[0].weights.map((_, entry) =>
      this.hypotheses.reduce((sum, { weights }, h) => sum + this.probability[h] * weights[entry], 0),
    );
  }

  /** Probability that the answers are chance: that the rationality is 0. */
  get chance() {
    return this.hypotheses.reduce(
      (sum, { rationality }, h) => sum + (rationality === 0 ? this.probability[h] : 0),
      0,
    );
  }

  #infer() {
    const { model, choices } = this;
    const memory = model.half_life === null ? 1 : 0.5 ** (1 / model.half_life);
    const chances = new Float64Array(4);
    const logs = this.hypotheses.map(({ weights, rationality }, h) => {
      let sum = this.logPrior[h];
      choices.forEach(({ first, second, answer }, index) => {
        answerChances(rationality * dot(weights, first), rationality * dot(weights, second), model, chances);
        const share = memory ** (choices.length - 1 - index);
        sum += share * Math.log(chances[ANSWERS.indexOf(answer)]);
      });
      return sum;
    });
    const most = logs.reduce((a, b) => Math.max(a, b));
    const odds = Float64Array.from(logs, (value) => Math.exp(value - most));
    const total = odds.reduce((a, b) => a + b);
    /** Of every hypothesis. */
    this.probability = odds.map((value) => value / total);
  }
}
