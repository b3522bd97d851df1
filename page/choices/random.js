// Random numbers as torch.Generator draws them on a CPU, so that a page asks what recipes.choices asks.

const SIZE = 624;
const SHIFT = 397;

/** The Mersenne twister: Matsumoto and Nishimura, https://doi.org/10.1145/272991.272995. */
export class Generator {
  /** As `torch.Generator().manual_seed(seed)`, for seeds below 2^53. */
  constructor(seed) {
    this.state = new Uint32Array(SIZE);
    this.state[0] = seed % 2 ** 32;
    for (let i = 1; i < SIZE; i++) {
      const before = this.state[i - 1] ^ (this.state[i - 1] >>> 30);
      this.state[i] = Math.imul(1812433253, before) + i;
    }
    this.place = SIZE;
  }

  /** 32 random bits. */
  bits() {
    if (this.place === SIZE) this.#twist();
    let y = this.state[this.place++];
    y ^= y >>> 11;
    y ^= (y << 7) & 0x9d2c5680;
    y ^= (y << 15) & 0xefc60000;
    return (y ^ (y >>> 18)) >>> 0;
  }

  /** `count` whole numbers from 0 to below `high`, as `torch.randint(high, (count,))`; `high` below 2^28. */
  integers(high, count) {
    return Uint32Array.from({ length: count }, () => this.bits() % high);
  }

  #twist() {
    const { state } = this;
    for (let i = 0; i < SIZE; i++) {
      const y = (state[i] & 0x80000000) | (state[(i + 1) % SIZE] & 0x7fffffff);
      state[i] = state[(i + SHIFT) % SIZE] ^ (y >>> 1) ^ (y & 1 ? 0x9908b0df : 0);
    }
    this.place = 0;
  }
}
