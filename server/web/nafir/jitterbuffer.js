// An adaptive playout buffer between a bursty network and the sound card. It does no I/O, so that the worklet and tests can drive it.
// Positions count samples since the first one pushed, the same for all channels: two ears, or those of ambisonics.
//
// Samples are played bit for bit. Splices compensate clock drift and changing jitter: one quantum crossfades to the same signal a few
// milliseconds later (to shorten the buffer) or earlier (to lengthen it), at the lag where the two match best. A buffer that is about to run
// dry is lengthened so, too: what is rarely late is stretched over and so needs no room in the buffer all the time.

const QUANTUM = 128; // samples that the Web Audio API processes at once
const RESERVE = 64; // samples held back so that an empty buffer ends in a fade and not in a click
const WINDOW_S = 1; // the lowest fill is measured in windows of this length
const MEMORY_S = 15; // the buffer is shortened a little only after so long without a second dip, since jitter may be rare
const LATELY_S = 3; // the buffer is lengthened where more than half of the windows in this time had too little
const SOON_S = 2; // a much too long buffer, as after a burst that follows a dropout, is shortened after this time
const MUCH_S = 0.025;
const AGAIN_S = 0.2; // time from a splice that did not suffice to the next one
const JUMP_S = 0.15; // if the fill is this far above the headroom, as after a burst, half of it is skipped at once
const HEADROOM_S = 0.05; // target of the lowest fill until the jitter is known
const LEAST = 2 * QUANTUM + RESERVE; // samples: with less, a block that is one quantum late may be a dropout
const MARGIN_S = 0.004; // target of the lowest fill above that, without any jitter
const SHARE_OF_JITTER = 0.75; // added to it: how much deeper than the jitter a dip may be and nothing is stretched
const JITTER_WINDOWS = 30; // the jitter is that of so many windows
const USUAL = 0.9; // share of them whose dips are no deeper than the jitter
const FALL_S = 0.004; // the headroom shrinks by at most so much in a window
const START_S = 0.05; // additional headroom at first, while page, server and sound card are busy with starting
const STARTING = 3; // windows with the additional headroom
const RIPPLE_S = 0.015; // variation of the fill between the arrival of one block and the next
const MAX_HEADROOM_S = 0.25;
const SLACK_S = 0.006; // the buffer is shortened only if the fill is this far above the headroom
const GROWTH_S = 0.015; // each dropout increases the headroom by this much, some of which is given back in each window
const GROWTH_BY_STRETCH_S = 0.002;
const GIVEN_BACK_S = 0.0002; // so one stretch in ten seconds is taken
const MOST_STRETCHES = 4; // without a block in between: more would buzz, and a dropout is told
const SHORTEST_LAG_S = 0.002; // of a splice
const LONGEST_LAG_S = 0.012; // a period of the deepest voices, at every rate
const COARSE_HZ = 24_000; // lags are tried that are a sample of about this rate apart
const ALIKE = 0.02; // signals that differ by this share of their power or less, -17 dB, match: any of those lags will do
const INAUDIBLE = 1e-4; // sum of squares over a quantum of the first two channels, 60 dB below full scale

const raisedCosine = (length) => Float32Array.from({ length }, (_, i) => 0.5 - 0.5 * Math.cos((Math.PI * (i + 0.5)) / length));
const CROSSFADE = raisedCosine(QUANTUM);
const FADE = raisedCosine(RESERVE);

export class JitterBuffer {
  constructor({ sampleRate, channels = 2, capacityS = 4 }) {
    this.sampleRate = sampleRate;
    this.capacity = Math.round(sampleRate * capacityS);
    this.rings = Array.from({ length: channels }, () => new Float32Array(this.capacity));
    this.counters = { underruns: 0, splices: 0, stretches: 0, gaps: 0, overflows: 0, late: 0, blocks: 0 };
    this.isEnding = false; // whether nothing more comes: that it runs dry is no dropout then
    this.read = 0;
    this.written = 0;
    this.playing = false;
    this.started = false;
    this.headroomS = HEADROOM_S + START_S;
    this.falls = []; // how far the fill fell below its mean in each of the last windows, in seconds
    this.grownS = 0; // by dropouts and stretches
    this.stretched = 0; // times since the last block
    this.starting = STARTING;
    this.isShortening = false;
    this.nextClock = null;
    this.marks = []; // {at, poseId, reverberationPoseId, fill}: where a newer pose becomes audible
    this.newestPose = -1;
    this.newestReverberationPose = -1;
    this.dips = []; // {lowest, seconds} of each window of the last MEMORY_S since playing began
    this.#openWindow();
  }

  #openWindow(seconds = WINDOW_S) {
    this.added = 0; // samples by which this window was stretched, which its fills leave out
    this.lowest = Infinity;
    this.sum = this.count = 0; // of the fills in this window
    this.windowS = seconds;
    this.windowLeft = Math.round(seconds * this.sampleRate);
  }

  /** Samples waiting to be played. */
  get fill() {
    return this.written - this.read;
  }

  /** Target of the fill in samples, at which playing starts: the headroom and the ripple above it. */
  get target() {
    return Math.round((this.headroomS + RIPPLE_S) * this.sampleRate);
  }

  push({ channels, sampleClock, poseId, reverberationPoseId = poseId, late }) {
    const frames = channels[0].length;
    this.counters.blocks += 1;
    this.stretched = 0;
    if (late) this.counters.late += 1;
    const joined = this.nextClock === null || sampleClock === this.nextClock;
    this.nextClock = sampleClock + frames;
    if (this.fill + frames > this.capacity / 2) {
      // The sound card has stopped taking samples (a sleeping tab). The oldest samples are dropped.
      this.counters.overflows += 1;
      this.read = this.written + frames - this.target;
    }
    if (!joined) this.counters.gaps += 1;
    const soften = !joined && this.fill >= RESERVE;
    this.rings.forEach((ring, index) => {
      for (let i = 0; soften && i < RESERVE; i++) ring[(this.written - RESERVE + i) % this.capacity] *= 1 - FADE[i];
      for (let i = 0; i < frames; i++) {
        const gain = !joined && i < RESERVE ? FADE[i] : 1;
        ring[(this.written + i) % this.capacity] = gain * channels[index][i];
      }
    });
    if (poseId > this.newestPose || reverberationPoseId > this.newestReverberationPose) {
      this.newestPose = poseId;
      this.newestReverberationPose = reverberationPoseId;
      this.marks.push({ at: this.written, poseId, reverberationPoseId, fill: Math.max(0, this.fill) });
    }
    this.written += frames;
  }

  /**
   * Fills the outputs, one for each channel (QUANTUM samples each). Returns the poses that become audible in them, as
   * [{poseId, reverberationPoseId, offset, fill}] with `offset` in samples from the start of the outputs.
   */
  pull(outputs) {
    const frames = outputs[0].length;
    if (!this.playing && this.fill >= this.target) {
      this.playing = true;
      this.started = true;
      this.read = this.written - this.target; // older samples of the same burst would only add delay
      this.dips = [];
      this.#openWindow();
      this.#copy(outputs, frames);
      this.#ramp(outputs, FADE, 0, false);
      return this.#heard(frames);
    }
    if (!this.playing) {
      for (const samples of outputs) samples.fill(0);
      return [];
    }
    if (this.fill < frames + RESERVE) return this.#runDry(outputs, frames);
    this.lowest = Math.min(this.lowest, this.fill - this.added);
    this.sum += this.fill - this.added;
    this.count += 1;
    this.windowLeft -= frames;
    const stretch = this.fill < LEAST ? this.#stretch() : 0;
    const lag = stretch || (this.windowLeft <= 0 ? this.#correction() : 0);
    if (lag !== 0) this.#splice(outputs, lag);
    else this.#copy(outputs, frames);
    if (stretch) this.added -= stretch;
    else if (lag !== 0) this.#openWindow(AGAIN_S);
    return this.#heard(frames);
  }

  /** Samples to repeat (negative) since the buffer is about to run dry; 0 if nothing more comes or so much has been stretched already. */
  #stretch() {
    if (this.isEnding || this.stretched === MOST_STRETCHES) return 0;
    const lag = this.#bestLag(-1, Infinity);
    if (lag === 0) return 0;
    this.stretched += 1;
    this.counters.stretches += 1;
    this.grownS = Math.min(MAX_HEADROOM_S, this.grownS + GROWTH_BY_STRETCH_S);
    return lag;
  }

  #copy(outputs, frames) {
    outputs.forEach((samples, index) => {
      const ring = this.rings[index];
      for (let i = 0; i < frames; i++) samples[i] = ring[(this.read + i) % this.capacity];
    });
    this.read += frames;
  }

  #ramp(outputs, shape, start, falling) {
    for (const samples of outputs) {
      for (let i = 0; i < shape.length && start + i < samples.length; i++) samples[start + i] *= falling ? 1 - shape[i] : shape[i];
    }
  }

  #runDry(outputs, frames) {
    const rest = Math.min(this.fill, frames);
    for (const samples of outputs) samples.fill(0);
    const last = outputs.map((samples) => samples.subarray(0, rest));
    this.#copy(last, rest);
    const start = Math.max(0, rest - RESERVE);
    this.#ramp(last, FADE.subarray(0, rest - start), start, true);
    this.playing = false;
    if (this.isEnding) return this.#heard(rest);
    this.counters.underruns += 1;
    this.grownS = Math.min(MAX_HEADROOM_S, this.grownS + GROWTH_S);
    this.headroomS = Math.min(MAX_HEADROOM_S, this.headroomS + GROWTH_S);
    return this.#heard(rest);
  }

  /** Samples to skip (positive) or to repeat (negative) at the end of a window; 0 changes nothing. */
  #correction() {
    const lowest = this.lowest + this.added;
    this.#remember();
    this.#adapt();
    this.#openWindow();
    const headroom = this.headroomS * this.sampleRate;
    // A quantum before it is low enough to be stretched, so that a clock that differs is no late block.
    if (this.#lowLately < Math.max(headroom / 2, LEAST + QUANTUM)) return this.#bestLag(-1, headroom);
    if (lowest > headroom + JUMP_S * this.sampleRate) return Math.round((lowest - headroom) / 2);
    const slack = SLACK_S * this.sampleRate;
    const recent = this.#lowestOf(SOON_S) - headroom;
    this.isShortening = recent > (this.isShortening ? slack : MUCH_S * this.sampleRate);
    return this.isShortening || this.#lowestOf(MEMORY_S, 1) - headroom > slack ? this.#bestLag(1, recent - slack / 2) : 0;
  }

  /** Sets the headroom by the jitter: more at once, less step by step. */
  #adapt() {
    if (this.starting > 0) {
      if (--this.starting === 0) this.headroomS -= START_S; // that of the start ends at once
      return;
    }
    if (this.windowS === WINDOW_S) this.falls.push((this.sum / this.count - this.lowest) / this.sampleRate);
    if (this.falls.length > JITTER_WINDOWS) this.falls.shift();
    this.grownS = Math.max(0, this.grownS - GIVEN_BACK_S);
    const wantedS = Math.min(MAX_HEADROOM_S, LEAST / this.sampleRate + MARGIN_S + SHARE_OF_JITTER * this.jitterS + this.grownS);
    this.headroomS = Math.max(wantedS, this.headroomS - FALL_S);
  }

  /** How far the fill usually falls below its mean, in seconds. */
  get jitterS() {
    return [...this.falls].sort((a, b) => a - b)[Math.floor(USUAL * (this.falls.length - 1) + 0.5)] ?? 0;
  }

  #remember() {
    this.dips.push({ lowest: this.lowest + this.added, seconds: this.windowS });
    while (this.#rememberedS - this.dips[0].seconds >= MEMORY_S) this.dips.shift();
  }

  get #rememberedS() {
    return this.dips.reduce((sum, { seconds }) => sum + seconds, 0);
  }

  /** The lowest fills of the windows in the last seconds, in samples, lowest first; empty until so much has been played. */
  #lowsOf(seconds) {
    const lows = [];
    let covered = 0;
    for (let index = this.dips.length - 1; index >= 0 && covered < seconds - 1e-6; index--) {
      lows.push(this.dips[index].lowest);
      covered += this.dips[index].seconds;
    }
    return covered < seconds - 1e-6 ? [] : lows.sort((a, b) => a - b);
  }

  /** The lowest fill of the last seconds, but for `ignored` windows, in samples; -Infinity until so much has been played. */
  #lowestOf(seconds, ignored = 0) {
    return this.#lowsOf(seconds)[ignored] ?? -Infinity;
  }

  /** The median of the windows' lowest fills lately; the newest until there is one. */
  get #lowLately() {
    const lows = this.#lowsOf(LATELY_S);
    return lows.length > 0 ? lows[Math.floor(lows.length / 2)] : this.dips.at(-1).lowest;
  }

  /** The longest lag at which the signal matches, or else the one at which it matches best. */
  #bestLag(sign, limit) {
    const [first, second] = this.rings; // of ambisonics, the sound from everywhere and that from the side
    const differences = [];
    let power = 0;
    const shortest = Math.round(SHORTEST_LAG_S * this.sampleRate);
    const step = Math.max(1, Math.round(this.sampleRate / COARSE_HZ)); // so that it costs about the same at every rate
    for (let lag = shortest; lag <= Math.min(LONGEST_LAG_S * this.sampleRate, limit); lag += step) {
      const shift = sign * lag;
      if (shift > 0 && this.fill < QUANTUM + shift + RESERVE) break;
      if (shift < 0 && this.read + shift < 0) break;
      let difference = 0;
      for (let i = 0; i < QUANTUM; i += 2) {
        const here = (this.read + i) % this.capacity;
        const there = (this.read + i + shift) % this.capacity;
        difference += (first[here] - first[there]) ** 2 + (second[here] - second[there]) ** 2;
      }
      differences.push(difference);
    }
    for (let i = 0; i < QUANTUM; i += 2) {
      const here = (this.read + i) % this.capacity;
      power += first[here] ** 2 + second[here] ** 2;
    }
    const enough = Math.max(1.1 * Math.min(...differences), ALIKE * power) + INAUDIBLE;
    const at = differences.findLastIndex((difference) => difference <= enough);
    return at < 0 ? 0 : sign * (shortest + at * step);
  }

  #splice(outputs, lag) {
    outputs.forEach((samples, index) => {
      const ring = this.rings[index];
      for (let i = 0; i < QUANTUM; i++) {
        const here = (this.read + i) % this.capacity;
        const there = (this.read + i + lag) % this.capacity;
        samples[i] = ring[here] + CROSSFADE[i] * (ring[there] - ring[here]);
      }
    });
    this.read += QUANTUM + lag;
    this.counters.splices += 1;
    this.dips = this.dips.map(({ lowest, seconds }) => ({ lowest: lowest - lag, seconds }));
  }

  #heard(frames) {
    const heard = [];
    while (this.marks.length > 0 && this.marks[0].at < this.read) {
      const { at, ...mark } = this.marks.shift();
      heard.push({ ...mark, offset: Math.min(frames, Math.max(0, at - (this.read - frames))) });
    }
    return heard;
  }
}
