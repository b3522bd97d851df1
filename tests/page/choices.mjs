// Asks and answers as the page does, and drives what it asks about: JSON in, JSON out.
//   node choices.mjs JOB.json
import { readFileSync } from "node:fs";

import { alternative } from "../../page/choices/alternative.js";
import { Dialogue } from "../../page/choices/dialogue.js";
import { Posterior } from "../../page/choices/posterior.js";
import { bestPreference, nextQuestion, worths } from "../../page/choices/question.js";
import { Generator } from "../../page/choices/random.js";
import { readPolicies } from "../../page/simulation/policy.js";

const job = JSON.parse(readFileSync(process.argv[2], "utf8"));
const result = {};

if (job.random) result.random = job.random.map(([seed, high, count]) => [...new Generator(seed).integers(high, count)]);

// A posterior of any number of objectives: after each answer, what is known.
if (job.posterior) {
  const { size, model, divisions, answers, pairs, outcomes, valid } = job.posterior;
  const posterior = new Posterior(size, model, divisions);
  result.posterior = answers.map((one) => {
    if (one === null) posterior.undo();
    else posterior.answer(...one);
    const { probability, chance, mean } = posterior;
    return { probability: [...probability], chance, mean, worths: worths(posterior, pairs, outcomes) };
  });
  result.best = bestPreference(posterior, outcomes);
  result.question = nextQuestion(posterior, outcomes, valid, new Generator(5), 50);
}

// A dialogue on a page: what is asked before each key, and what is known after the last.
for (const log of job.logs ?? []) {
  const dialogue = new Dialogue(job.choices);
  const questions = [];
  for (const key of log) {
    questions.push(dialogue.question);
    dialogue.take(key);
  }
  questions.push(dialogue.question);
  const again = new Dialogue(job.choices);
  again.replay(dialogue.log);
  const { best, posterior, log: kept } = dialogue;
  const said = { questions, best, kept, probability: [...posterior.probability], again: [...again.posterior.probability] };
  (result.dialogues ??= []).push(said);
}

if (job.drives) {
  const policy = readPolicies({ it: job.entry }, job.robot).it;
  const { robot, entry } = job;
  result.drives = job.drives.map(([scene, preference]) =>
    alternative(job.choices.scenes[scene], job.choices.preferences[preference], { robot, policy, entry }),
  );
}

console.log(JSON.stringify(result));
