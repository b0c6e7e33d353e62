// The gate at the beginning of a decoded response (server/field/gate.py): it silences what windows smear to before sound can arrive from a
// surface, and gives that energy to the sound that follows.

const RISE_S = 0.0003;
const RISE_AFTER_FIRST_S = 0.003;
const MOST_GIVEN = 15;

const riseOf = (samples) => Float64Array.from({ length: samples }, (_, i) => Math.sin(((Math.PI / 2) * (i + 0.5)) / samples) ** 2);

/** Half to even, as Python rounds. */
const rounded = (value) => {
  const near = Math.round(value);
  return near - value === 0.5 && near % 2 !== 0 ? near - 1 : near;
};

export class Gate {
  #rise;
  #answer;
  #given;

  constructor({ sample_rate: sampleRate, n_fft: window }, { hasFirstReflections }) {
    this.#rise = riseOf(rounded((hasFirstReflections ? RISE_AFTER_FIRST_S : RISE_S) * sampleRate));
    this.#answer = riseOf(rounded(RISE_S * sampleRate));
    this.#given = Float64Array.from({ length: window }, (_, i) => 0.5 + 0.5 * Math.cos((Math.PI * i) / window));
  }

  /** Opens channels in place, all as the first one needs: sound arrives at sample `onset`, and from a surface by sample `echo`. */
  open(channels, onset, echo) {
    const [reference] = channels;
    const begin = echo - this.#answer.length;
    const opens = Math.min(reference.length, Math.max(0, onset, begin));
    const gains = new Float64Array(reference.length).fill(1, opens);
    for (const [start, rise] of [[onset, this.#rise], [begin, this.#answer]]) {
      for (let n = Math.max(opens, start); n < Math.min(gains.length, start + rise.length); n++) gains[n] *= rise[n - start];
    }
    let [taken, held] = [0, 0];
    for (let n = 0; n < gains.length; n++) {
      const power = reference[n] ** 2;
      const kept = power * gains[n] ** 2;
      taken += power - kept;
      held += kept * (this.#given[n - opens] ?? 0);
    }
    const share = taken < MOST_GIVEN * held ? taken / held : MOST_GIVEN;
    const until = Math.min(gains.length, opens + this.#given.length);
    for (let n = opens; n < until; n++) gains[n] *= Math.sqrt(1 + share * this.#given[n - opens]);
    for (const channel of channels) for (let n = 0; n < until; n++) channel[n] *= gains[n];
  }
}
