// What to ask next, and what to give the policy: next_question and best_preference of torchrl_morl.choices.
import { answerChances, dot } from "./posterior.js";

// As torchrl_morl.choices.question has them.
const NEGLIGIBLE = 1e-5;
const LEAST_DRAWS = 4096;
const BIT = 0.01;

/**
 * What the answers to questions are expected to tell and to change: `information` in bits, and `value`, what they
 * add to the satisfaction with the recommended alternative. `pairs` of outcomes [first, second].
 */
export function worths(posterior, pairs, outcomes) {
  const { probability, hypotheses, model } = posterior;
  const order = Array.from(probability.keys()).sort((a, b) => probability[b] - probability[a]);
  let mass = 0;
  let count = 0;
  // All that are needed to have nearly all of the probability, and the one that completes it.
  while (count < order.length && mass < 1 - NEGLIGIBLE) mass += probability[order[count++]];
  const kept = order.slice(0, count).map((h) => hypotheses[h]);
  const shares = Float64Array.from(order.slice(0, count), (h) => probability[h] / mass);
  // This runs a million times a question: flat arrays, and weights that are multiplied before.
  const size = kept[0].weights.length;
  const scaled = Float64Array.from(
    kept.flatMap(({ weights, rationality }) => weights.map((weight) => rationality * weight)),
  );
  const mean = meanOutcomes(outcomes);
  const satisfied = Float64Array.from(
    kept.flatMap(({ weights }, h) => inSatisfaction(weights, mean).map((weight) => shares[h] * weight)),
  );
  const most = (sums) => mean.reduce((best, row) => Math.max(best, dot(sums, row)), -Infinity);
  const total = new Float64Array(size);
  satisfied.forEach((value, place) => (total[place % size] += value));
  const now = most(total);
  const chances = new Float64Array(4);
  return pairs.map(([first, second]) => {
    const overall = new Float64Array(4);
    // The satisfaction of a hypothesis is linear in mean outcomes: sums over hypotheses are taken first.
    const after = Array.from(chances, () => new Float64Array(size));
    let within = 0;
    for (let h = 0, start = 0; h < count; h++, start += size) {
      let [u, v] = [0, 0];
      for (let entry = 0; entry < size; entry++) {
        u += scaled[start + entry] * first[entry];
        v += scaled[start + entry] * second[entry];
      }
      answerChances(u, v, model, chances);
      let logs = 0;
      for (let answer = 0; answer < 4; answer++) {
        const chance = chances[answer];
        const sums = after[answer];
        overall[answer] += shares[h] * chance;
        for (let entry = 0; entry < size; entry++) sums[entry] += chance * satisfied[start + entry];
        if (chance > 0) logs += chance * Math.log(chance);
      }
      within += shares[h] * logs;
    }
    for (const chance of overall) if (chance > 0) within -= chance * Math.log(chance);
    const value = after.reduce((sum, sums) => sum + most(sums), 0) - now;
    return { value: Math.max(value, 0), information: Math.max(within, 0) / Math.LN2 };
  });
}

/**
 * The most valuable of some typical questions that are drawn: { scene, first, second, value, information }.
 *
 * @param outcomes [scene][alternative][objective]
 * @param valid which may be shown, [scene][alternative]
 * @param generator a `Generator`
 */
export function nextQuestion(posterior, outcomes, valid, generator, candidates = 500, typical = 0.3) {
  const wanted = Math.floor(candidates / typical);
  const draws = Math.max(2 * wanted, LEAST_DRAWS);
  const scenes = generator.integers(outcomes.length, draws);
  const firsts = generator.integers(outcomes[0].length, draws);
  const seconds = generator.integers(outcomes[0].length, draws);
  const drawn = [];
  for (let draw = 0; draw < draws && drawn.length < wanted; draw++) {
    const [scene, first, second] = [scenes[draw], firsts[draw], seconds[draw]];
    const rows = outcomes[scene];
    if (!valid[scene][first] || !valid[scene][second]) continue;
    if (rows[first].every((value, entry) => value === rows[second][entry])) continue;
    drawn.push({ scene, first, second });
  }
  if (!drawn.length) throw new Error("No two drives that may be shown differ.");
  const mean = meanOutcomes(outcomes);
  const unlike = drawn.map(({ scene, first, second }) => {
    const here = Array.from(outcomes[scene][first], (value, entry) => value - outcomes[scene][second][entry]);
    const everywhere = mean[first].map((value, entry) => value - mean[second][entry]);
    const apart = here.map((value, entry) => value - everywhere[entry]);
    return Math.hypot(...apart) / (Math.hypot(...here) + Math.hypot(...everywhere));
  });
  // In the order of the draws again, so that of equal questions the first is taken.
  const questions = [...drawn.keys()]
    .sort((a, b) => unlike[a] - unlike[b])
    .slice(0, Math.ceil(typical * drawn.length))
    .sort((a, b) => a - b)
    .slice(0, candidates)
    .map((row) => drawn[row]);
  const pairs = questions.map(({ scene, first, second }) => [outcomes[scene][first], outcomes[scene][second]]);
  const found = worths(posterior, pairs, outcomes);
  const scores = found.map(({ value, information }) => value + BIT * information);
  const best = scores.indexOf(scores.reduce((a, b) => Math.max(a, b)));
  return { ...questions[best], ...found[best] };
}

/**
 * The alternative of greatest expected utility: its index, `satisfaction` of every one, the expected `regret`
 * and `regretHigh`, what it misses at most with a probability of 90 %.
 */
export function bestPreference(posterior, outcomes) {
  const { probability, hypotheses } = posterior;
  const mean = meanOutcomes(outcomes);
  const satisfied = hypotheses.map(({ weights }) => {
    const scaled = inSatisfaction(weights, mean);
    const utility = mean.map((values) => dot(scaled, values));
    const high = Math.max(...utility);
    return utility.map((value) => 1 + value - high);
  });
  const satisfaction = mean.map((_, alternative) =>
    satisfied.reduce((sum, values, h) => sum + probability[h] * values[alternative], 0),
  );
  const index = satisfaction.indexOf(Math.max(...satisfaction));
  const missed = satisfied.map((values, h) => [1 - values[index], probability[h]]).sort((a, b) => a[0] - b[0]);
  let sum = 0;
  const high = missed.find(([, chance]) => (sum += chance) >= 0.9) ?? missed[missed.length - 1];
  return { index, satisfaction, regret: 1 - satisfaction[index], regretHigh: high[0] };
}

/** Of every alternative over all scenes, [alternative][objective]. */
function meanOutcomes(outcomes) {
  return outcomes[0].map((row, alternative) =>
    Array.from(row, (_, entry) =>
      outcomes.reduce((sum, scene) => sum + scene[alternative][entry], 0) / outcomes.length,
    ),
  );
}

/** Weights in the unit of the way from the worst alternative to the best: `in_satisfaction` of torchrl_morl.choices. */
function inSatisfaction(weights, mean) {
  const utility = mean.map((values) => dot(weights, values));
  const way = Math.max(...utility) - Math.min(...utility);
  return weights.map((weight) => (way > 0 ? weight / Math.max(way, 1e-12) : 0));
}
