// What to ask next, and what to give the policy: next_question and best_preference of torchrl_morl.choices.
import { answerChances, dot } from "./posterior.js";

// As torchrl_morl.choices.question has them.
const NEGLIGIBLE = 1e-5;
const LEAST_DRAWS = 4096;

/**
 * Bits that the answers to questions are expected to tell; `pairs` of outcomes [first, second].
 */
export function information(posterior, pairs) {
  const { probability, hypotheses, model } = posterior;
  const order = Array.from(probability.keys()).sort((a, b) => probability[b] - probability[a]);
  let mass = 0;
  let count = 0;
  // All that are needed to have nearly all of the probability, and the one that completes it.
  while (count < order.length && mass < 1 - NEGLIGIBLE) mass += probability[order[count++]];
  const kept = order.slice(0, count).map((h) => hypotheses[h]);
  const shares = Float64Array.from(order.slice(0, count), (h) => probability[h] / mass);
  // This runs a million times a question: flat arrays, and weights that are multiplied by the rationality before.
  const size = kept[0].weights.length;
  const scaled = Float64Array.from(
    kept.flatMap(({ weights, rationality }) => weights.map((weight) => rationality * weight)),
  );
  const chances = new Float64Array(4);
  return pairs.map(([first, second]) => {
    const overall = new Float64Array(4);
    let within = 0;
    for (let h = 0, place = 0; h < count; h++) {
      let [u, v] = [0, 0];
      for (let entry = 0; entry < size; entry++, place++) {
        u += scaled[place] * first[entry];
        v += scaled[place] * second[entry];
      }
      answerChances(u, v, model, chances);
      let logs = 0;
      for (let answer = 0; answer < 4; answer++) {
        const chance = chances[answer];
        overall[answer] += shares[h] * chance;
        if (chance > 0) logs += chance * Math.log(chance);
      }
      within += shares[h] * logs;
    }
    for (const chance of overall) if (chance > 0) within -= chance * Math.log(chance);
    return Math.max(within, 0) / Math.LN2;
  });
}

/**
 * The most informative of some questions that are drawn: { scene, first, second, information }.
 *
 * @param outcomes [scene][alternative][objective]
 * @param valid which may be shown, [scene][alternative]
 * @param generator a `Generator`
 */
export function nextQuestion(posterior, outcomes, valid, generator, candidates = 1000) {
  const draws = Math.max(4 * candidates, LEAST_DRAWS);
  const scenes = generator.integers(outcomes.length, draws);
  const firsts = generator.integers(outcomes[0].length, draws);
  const seconds = generator.integers(outcomes[0].length, draws);
  const questions = [];
  for (let draw = 0; draw < draws && questions.length < candidates; draw++) {
    const [scene, first, second] = [scenes[draw], firsts[draw], seconds[draw]];
    const rows = outcomes[scene];
    if (!valid[scene][first] || !valid[scene][second]) continue;
    if (rows[first].every((value, entry) => value === rows[second][entry])) continue;
    questions.push({ scene, first, second });
  }
  if (!questions.length) throw new Error("No two drives that may be shown differ.");
  const pairs = questions.map(({ scene, first, second }) => [outcomes[scene][first], outcomes[scene][second]]);
  const bits = information(posterior, pairs);
  const best = bits.indexOf(bits.reduce((a, b) => Math.max(a, b)));
  return { ...questions[best], information: bits[best] };
}

/**
 * The alternative of greatest expected utility: its index, `satisfaction` of every one, the expected `regret`
 * and `regretHigh`, what it misses at most with a probability of 90 %.
 */
export function bestPreference(posterior, outcomes) {
  const { probability, hypotheses } = posterior;
  const mean = outcomes[0].map((row, alternative) =>
    Array.from(row, (_, entry) =>
      outcomes.reduce((sum, scene) => sum + scene[alternative][entry], 0) / outcomes.length,
    ),
  );
  const satisfied = hypotheses.map(({ weights }) => {
    const utility = mean.map((values) => dot(weights, values));
    const low = Math.min(...utility);
    const high = Math.max(...utility);
    return utility.map((value) => (high > low ? (value - low) / Math.max(high - low, 1e-12) : 1));
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
