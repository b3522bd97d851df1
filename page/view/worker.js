// Previews, apart from the page so that it stays smooth: rollouts from one moment, of every corner preference and of
// the present one.
import { Policy, bytes } from "../simulation/policy.js";
import { preview } from "../simulation/preview.js";

/** Answer the messages of `Previews`, in a worker. */
export function serve(scope) {
  const policies = {};
  scope.onmessage = ({ data }) => {
    if (data.policies) {
      for (const [name, entry] of Object.entries(data.policies)) {
        policies[name] = new Policy(entry, bytes(entry.weights));
      }
      return;
    }
    const { number, moment, name, preference, clamped } = data;
    const policy = policies[name];
    const way = (weights) => preview(moment, policy, weights, { clamped });
    const ways = policy.tunable.map((_, corner) =>
      way(policy.tunable.map((_, entry) => (entry === corner ? 1 : 0))),
    );
    scope.postMessage({ number, ways, own: way(preference) });
  };
}

/** Asks a worker that runs the page's own script; one question at a time, the latest. */
export class Previews {
  constructor(script, policies) {
    const address = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
    this.worker = new Worker(address);
    this.worker.postMessage({ policies });
    this.number = 0;
    this.busy = false;
    this.waiting = null;
    /** The latest answer, one { points, ending } a corner. */
    this.ways = [];
    /** The same under the preference of the question, or null. */
    this.own = null;
    this.worker.onmessage = ({ data }) => {
      this.busy = false;
      if (data.number >= this.valid) [this.ways, this.own] = [data.ways, data.own];
      if (this.waiting) this.ask(this.waiting);
    };
    this.valid = 0;
  }

  /** Where would it go from here? `question`: moment, name (of the policy), preference, clamped. */
  ask(question) {
    if (this.busy) {
      this.waiting = question;
      return;
    }
    this.waiting = null;
    this.busy = true;
    this.worker.postMessage({ ...question, number: ++this.number });
  }

  /** What was asked before is of another scene. */
  forget() {
    this.ways = [];
    this.own = null;
    this.waiting = null;
    this.valid = this.number + 1;
  }
}
