// Questions and answers with one person: Dialogue of recipes.choices. The same answers lead to the same questions.
import { bytes } from "../simulation/policy.js";
import { Posterior } from "./posterior.js";
import { bestPreference, nextQuestion } from "./question.js";
import { Generator } from "./random.js";

/** What is typed for which answer; "u" takes the last one back, "s" asks something else. */
export const KEYS = { 1: "first", 2: "second", "=": "tie", n: "neither" };

export class Dialogue {
  /** `told`: what a page holds of choices, see recipes/page/choices.py. */
  constructor(told) {
    const { preferences, model, divisions } = told;
    this.told = told;
    this.preferences = preferences;
    const size = preferences[0].length;
    const numbers = new Float32Array(bytes(told.outcomes).buffer);
    const row = (start) => numbers.subarray(start * size, (start + 1) * size);
    const table = (cell) =>
      told.scenes.map((_, scene) => preferences.map((_, one) => cell(scene * preferences.length + one)));
    /** [scene][preference][objective] and [scene][preference]. */
    this.outcomes = table(row);
    const arrived = bytes(told.arrived);
    this.arrived = table((place) => arrived[place] === 1);
    this.posterior = new Posterior(size, model, divisions);
    this.restart();
  }

  /** Forget all answers. */
  restart() {
    /** Everything that was typed; taken from there it all comes back. */
    this.log = "";
    this.valid = this.arrived.map((row) => [...row]);
    this.skipped = 0;
    this.posterior.restart();
    this.#changed();
  }

  /** How many answers there are. */
  get count() {
    return this.posterior.choices.length;
  }

  /** The most valuable question: { scene, first, second, value, information }, the places of two preferences. */
  get question() {
    const number = ((this.told.seed * 1000 + this.count) * 1000 + this.skipped) * 10;
    this.asked ??= nextQuestion(this.posterior, this.outcomes, this.valid, new Generator(number));
    return this.asked;
  }

  /** The preference to give the policy, and how sure it is. */
  get best() {
    this.found ??= bestPreference(this.posterior, this.outcomes);
    return { ...this.found, preference: this.preferences[this.found.index] };
  }

  /** Take what is typed: a key of KEYS, "u" or "s". False where it changes nothing. */
  take(key) {
    if (key === "u") {
      if (!this.count) return false;
      this.posterior.undo();
      this.skipped = 0;
      // What was skipped stays so, and then the order matters.
      this.log = this.log.includes("s") ? `${this.log}u` : this.log.slice(0, -1);
    } else if (key === "s") {
      const { scene, first } = this.question;
      this.valid[scene][first] = false;
      this.skipped++;
      this.log += key;
    } else {
      const { scene, first, second } = this.question;
      this.posterior.answer(this.outcomes[scene][first], this.outcomes[scene][second], KEYS[key]);
      this.skipped = 0;
      this.log += key;
    }
    this.#changed();
    return true;
  }

  /** Take what was typed before, as of a link. */
  replay(log) {
    if (log === this.log) return;
    this.restart();
    for (const key of log) this.take(key);
  }

  #changed() {
    this.asked = null;
    this.found = null;
  }
}
