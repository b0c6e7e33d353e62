// An adaptive playout buffer between a bursty network and the sound card. It does no I/O, so that the worklet and tests can drive it.
// Positions count samples since the first one pushed, the same for all channels: two ears, or those of ambisonics.
//
// Samples are played bit for bit. Splices compensate clock drift and changing jitter: one quantum crossfades to the same signal a few
// milliseconds later (to shorten the buffer) or earlier (to lengthen it), at the lag where the two match best.

const QUANTUM = 128; // samples that the Web Audio API processes at once
const RESERVE = 64; // samples held back so that an empty buffer ends in a fade and not in a click
const WINDOW_S = 1; // the lowest fill is measured in windows of this length
const MEMORY_S = 15; // the buffer is shortened a little only after so long without a dip, since jitter may be rare
const SOON_S = 2; // a much too long buffer, as after a burst that follows a dropout, is shortened after this time
const MUCH_S = 0.025;
const AGAIN_S = 0.2; // time from a splice that did not suffice to the next one
const JUMP_S = 0.15; // if the fill is this far above the headroom, as after a burst, half of it is skipped at once
const HEADROOM_S = 0.05; // target of the lowest fill until the jitter is known
const LEAST = 2 * QUANTUM + RESERVE; // samples: with less, a block that is one quantum late may be a dropout
const MARGIN_S = 0.004; // target of the lowest fill above that, without any jitter
const SHARE_OF_JITTER = 0.75; // added to it: how much deeper than ever before a dip may be without a dropout
const FALL_S = 0.004; // the headroom shrinks by at most so much in a window
const FORGETTING = 0.995; // of the jitter, in each window: half in over two minutes
const START_S = 0.05; // additional headroom at first, while page, server and sound card are busy with starting
const STARTING = 3; // windows with the additional headroom
const RIPPLE_S = 0.015; // variation of the fill between the arrival of one block and the next
const MAX_HEADROOM_S = 0.25;
const SLACK_S = 0.006; // the buffer is shortened only if the fill is this far above the headroom
const GROWTH_S = 0.015; // each dropout increases the headroom by this much, some of which is given back in each window
const GIVEN_BACK_S = 0.0002;
const SHORTEST_LAG_S = 0.002; // of a splice
const LONGEST_LAG_S = 0.012; // a period of the deepest voices, at every rate
const INAUDIBLE = 1e-4; // sum of squares over a quantum of the first two channels, 60 dB below full scale

const raisedCosine = (length) => Float32Array.from({ length }, (_, i) => 0.5 - 0.5 * Math.cos((Math.PI * (i + 0.5)) / length));
const CROSSFADE = raisedCosine(QUANTUM);
const FADE = raisedCosine(RESERVE);

export class JitterBuffer {
  constructor({ sampleRate, channels = 2, capacityS = 4 }) {
    this.sampleRate = sampleRate;
    this.capacity = Math.round(sampleRate * capacityS);
    this.rings = Array.from({ length: channels }, () => new Float32Array(this.capacity));
    this.counters = { underruns: 0, splices: 0, gaps: 0, overflows: 0, late: 0, blocks: 0 };
    this.isEnding = false; // whether nothing more comes: that it runs dry is no dropout then
    this.read = 0;
    this.written = 0;
    this.playing = false;
    this.started = false;
    this.headroomS = HEADROOM_S + START_S;
    this.jitterS = 0; // how far the fill falls below its mean: the most in a window, slowly forgotten
    this.grownS = 0; // by dropouts
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
    this.lowest = Math.min(this.lowest, this.fill);
    this.sum += this.fill;
    this.count += 1;
    this.windowLeft -= frames;
    const lag = this.windowLeft <= 0 ? this.#correction() : 0;
    if (lag !== 0 && frames === QUANTUM) this.#splice(outputs, lag);
    else this.#copy(outputs, frames);
    return this.#heard(frames);
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
    const { lowest } = this;
    this.#remember();
    this.#adapt();
    this.#openWindow();
    const headroom = this.headroomS * this.sampleRate;
    if (lowest < Math.max(headroom / 2, LEAST)) return this.#bestLag(-1, headroom);
    if (lowest > headroom + JUMP_S * this.sampleRate) return Math.round((lowest - headroom) / 2);
    const slack = SLACK_S * this.sampleRate;
    const recent = this.#lowestOf(SOON_S) - headroom;
    this.isShortening = recent > (this.isShortening ? slack : MUCH_S * this.sampleRate);
    return this.isShortening || this.#lowestOf(MEMORY_S) - headroom > slack ? this.#bestLag(1, recent - slack / 2) : 0;
  }

  /** Sets the headroom by the jitter: more at once, less step by step. */
  #adapt() {
    if (this.starting > 0) {
      if (--this.starting === 0) this.headroomS -= START_S; // that of the start ends at once
      return;
    }
    const dipS = (this.sum / this.count - this.lowest) / this.sampleRate;
    this.jitterS = Math.max(dipS, FORGETTING * this.jitterS);
    this.grownS = Math.max(0, this.grownS - GIVEN_BACK_S);
    const wantedS = Math.min(MAX_HEADROOM_S, LEAST / this.sampleRate + MARGIN_S + SHARE_OF_JITTER * this.jitterS + this.grownS);
    this.headroomS = Math.max(wantedS, this.headroomS - FALL_S);
  }

  #remember() {
    this.dips.push({ lowest: this.lowest, seconds: this.windowS });
    while (this.#rememberedS - this.dips[0].seconds >= MEMORY_S) this.dips.shift();
  }

  get #rememberedS() {
    return this.dips.reduce((sum, { seconds }) => sum + seconds, 0);
  }

  /** The lowest fill of the last seconds, in samples; -Infinity until so much has been played. */
  #lowestOf(seconds) {
    let lowest = Infinity;
    let covered = 0;
    for (let index = this.dips.length - 1; index >= 0 && covered < seconds - 1e-6; index--) {
      lowest = Math.min(lowest, this.dips[index].lowest);
      covered += this.dips[index].seconds;
    }
    return covered < seconds - 1e-6 ? -Infinity : lowest;
  }

  /** The lag at which the signal matches best; the longest if several do. */
  #bestLag(sign, limit) {
    const [first, second] = this.rings; // of ambisonics, the sound from everywhere and that from the side
    const differences = [];
    const shortest = Math.round(SHORTEST_LAG_S * this.sampleRate);
    for (let lag = shortest; lag <= Math.min(LONGEST_LAG_S * this.sampleRate, limit); lag++) {
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
    const enough = 1.1 * Math.min(...differences) + INAUDIBLE;
    const at = differences.findLastIndex((difference) => difference <= enough);
    return at < 0 ? 0 : sign * (shortest + at);
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
    this.#openWindow(AGAIN_S);
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
