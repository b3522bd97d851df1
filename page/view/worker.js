// Previews, apart from the page so that it stays smooth: rollouts from one moment, of every corner preference and of
// the present one.
import { readPolicies } from "../simulation/policy.js";
import { preview } from "../simulation/preview.js";

/** Answer the messages of `Previews`, in a worker. */
export function serve(scope) {
  let policies;
  scope.onmessage = ({ data }) => {
    if (data.policies) {
      policies = readPolicies(data.policies, data.robot);
      return;
    }
    const { number, moment, name, preference, clamped } = data;
    const policy = policies[name];
    const way = (weights) => preview(moment, policy, weights, { clamped });
    const ways = policy.tunable.map((_, corner) =>
      way(policy.tunable.map((_, entry) => (entry === corner ? 1 : 0))),
    );
    const names = ways.map((_, corner) => furthest(ways, corner));
    scope.postMessage({ number, ways, names, own: way(preference) });
  };
}

// Where a way lies furthest from the others, and further than a hand: there it gets its name.
function furthest(ways, corner) {
  let best = null;
  let most = 0.22;
  for (const point of ways[corner].points.slice(4)) {
    let least = Infinity;
    ways.forEach(({ points: others }, index) => {
      if (index === corner) return;
      for (const other of others) {
        least = Math.min(least, Math.hypot(point[0] - other[0], point[1] - other[1]));
      }
    });
    if (least > most) {
      most = least;
      best = point;
    }
  }
  return best;
}

/** Asks a worker that runs the page's own script; one question at a time, the latest. */
export class Previews {
  constructor(script, { policies, robot }) {
    const address = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
    this.worker = new Worker(address);
    this.worker.postMessage({ policies, robot });
    this.number = 0;
    this.busy = false;
    this.waiting = null;
    /** The latest answer, one { points, ending } a corner. */
    this.ways = [];
    /** Where each of them gets its name, [x, y]; null for one that is too near to the others. */
    this.names = [];
    /** The same under the preference of the question, or null. */
    this.own = null;
    /** Control steps of the episode at the question. */
    this.from = 0;
    this.worker.onmessage = ({ data }) => {
      this.busy = false;
      if (data.number >= this.valid) {
        ({ ways: this.ways, names: this.names, own: this.own } = data);
        this.from = this.asked;
      }
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
    this.asked = question.moment.elapsed;
    this.worker.postMessage({ ...question, number: ++this.number });
  }

  /**
   * What still lies ahead after `elapsed` control steps of the episode, as `ways`, `names` and `own`, in points.
   * A slow machine answers when the robot has gone on.
   */
  ahead(elapsed) {
    const passed = Math.max(elapsed - this.from, 0);
    return {
      ways: this.ways.map(({ points }) => points.slice(passed)),
      names: this.names.map((place, corner) =>
        place && this.ways[corner].points.indexOf(place) > passed ? place : null,
      ),
      own: this.own && this.own.points.slice(passed),
    };
  }

  /** What was asked before is of another scene. */
  forget() {
    this.ways = [];
    this.names = [];
    this.own = null;
    this.waiting = null;
    this.valid = this.number + 1;
  }
}
