// Discrete Frechet distance to a fixed path, while the other one grows: torchrl_morl.evaluation.discrete_frechet.

/** Add points one by one; ask at any time. */
export class Frechet {
  /** `path`: points [x, y], metres, at least one. */
  constructor(path) {
    this.path = path;
    this.row = null;
  }

  /** The other path goes on to (x, y). */
  add(x, y) {
    const before = this.row;
    this.row = new Float64Array(this.path.length);
    this.path.forEach(([px, py], column) => {
      const reach = Math.min(
        before ? before[column] : Infinity,
        column ? this.row[column - 1] : Infinity,
        before && column ? before[column - 1] : Infinity,
      );
      const distance = Math.hypot(x - px, y - py);
      this.row[column] = Number.isFinite(reach) ? Math.max(distance, reach) : distance;
    });
  }

  /** Metres between the whole paths. */
  get distance() {
    return this.row[this.row.length - 1];
  }

  /** Metres to the part of the fixed path that fits best so far. */
  get soFar() {
    return this.row.reduce((least, one) => Math.min(least, one), Infinity);
  }
}
