// One emitter's sound as first-order ambisonic channels (W, Y, Z, X in world axes): the direct sound by a delay line, which glides as its
// path does, and the room's answer by convolution in partitions of one quantum. It does no I/O, so that a worker and tests can drive it.

import { inverse, transform } from "./fourier.js";
import { BEFORE, PHASES, SINC_TAPS, sincTable } from "./plane_waves.js";

const CHANNELS = 4;
const GLIDE_QUANTA = 2; // in which a path becomes the next one
const JUMP_S = 0.005; // a path that is so much longer or shorter than the one before does not glide: its sound is faded

/** How many numbers the spectra of a response of so many samples are, in partitions of `quantum`. */
const spectraLength = (samples, quantum) => CHANNELS * Math.ceil(samples / quantum) * 2 * (quantum + 1);

/**
 * Spectra of a response (four channels) for a Convolver: for each partition and channel, real and then imaginary parts. They are written to
 * `into` if it is a Float32Array of the right length.
 */
export function spectraOf(channels, quantum, into = null) {
  const { length } = channels[0];
  const size = spectraLength(length, quantum);
  const spectra = into?.length === size ? into : new Float32Array(size);
  const bins = quantum + 1;
  const [re, im] = [new Float64Array(2 * quantum), new Float64Array(2 * quantum)];
  let at = 0;
  for (let start = 0; start < length; start += quantum) {
    for (const channel of channels) {
      re.fill(0);
      im.fill(0);
      re.set(channel.subarray(start, start + quantum));
      transform(re, im);
      spectra.set(re.subarray(0, bins), at);
      spectra.set(im.subarray(0, bins), at + bins);
      at += 2 * bins;
    }
  }
  return spectra;
}

/** Convolves a signal with a response that may be exchanged at any time: what has sounded before rings on in the new one. */
export class Convolver {
  #quantum;
  #partitions;
  #heard; // of each of the last partitions, the spectrum of the input: real parts, then imaginary ones
  #newest = 0;
  #spectra = null;
  #next = null;
  #input;
  #re;
  #im;
  #sums; // of each channel, real parts, then imaginary ones
  #before;

  constructor({ samples, quantum }) {
    this.#quantum = quantum;
    this.#partitions = Math.ceil(samples / quantum);
    this.#heard = Array.from({ length: this.#partitions }, () => new Float32Array(2 * (quantum + 1)));
    this.#input = new Float64Array(2 * quantum);
    [this.#re, this.#im] = [new Float64Array(2 * quantum), new Float64Array(2 * quantum)];
    this.#sums = Array.from({ length: CHANNELS }, () => new Float64Array(2 * (quantum + 1)));
    this.#before = Array.from({ length: CHANNELS }, () => new Float32Array(quantum));
  }

  /** Takes the `spectraOf` the next response, which fades in over a quantum. Returns spectra that are no longer needed, or null. */
  exchange(spectra) {
    const unused = this.#next;
    this.#next = spectra;
    return unused;
  }

  /** Adds the answer to a quantum of input to four outputs. Returns spectra that are no longer needed, or null. */
  process(input, outputs) {
    this.#take(input);
    if (!this.#next) {
      if (this.#spectra) this.#answer(this.#spectra, (channel, i, sample) => (outputs[channel][i] += sample));
      return null;
    }
    const [old, quantum] = [this.#spectra, this.#quantum];
    for (const channel of this.#before) channel.fill(0);
    if (old) this.#answer(old, (channel, i, sample) => (this.#before[channel][i] = sample));
    this.#answer(this.#next, (channel, i, sample) => {
      const before = this.#before[channel][i];
      outputs[channel][i] += before + ((i + 1) / quantum) * (sample - before);
    });
    [this.#spectra, this.#next] = [this.#next, null];
    return old;
  }

  #take(input) {
    const quantum = this.#quantum;
    this.#input.copyWithin(0, quantum);
    this.#input.set(input, quantum);
    this.#re.set(this.#input);
    this.#im.fill(0);
    transform(this.#re, this.#im);
    this.#newest = (this.#newest + this.#partitions - 1) % this.#partitions;
    const heard = this.#heard[this.#newest];
    heard.set(this.#re.subarray(0, quantum + 1));
    heard.set(this.#im.subarray(0, quantum + 1), quantum + 1);
  }

  #answer(spectra, write) {
    const quantum = this.#quantum;
    const bins = quantum + 1;
    for (const sum of this.#sums) sum.fill(0);
    let at = 0;
    for (let partition = 0; partition < this.#partitions; partition++) {
      const heard = this.#heard[(this.#newest + partition) % this.#partitions];
      for (let channel = 0; channel < CHANNELS; channel++, at += 2 * bins) multiplyAdd(heard, spectra, at, this.#sums[channel], bins);
    }
    // Two channels at a time: one in the real part, one in the imaginary part.
    for (let channel = 0; channel < CHANNELS; channel += 2) {
      const [one, other, re, im] = [this.#sums[channel], this.#sums[channel + 1], this.#re, this.#im];
      for (let k = 0; k < bins; k++) {
        re[k] = one[k] - other[bins + k];
        im[k] = one[bins + k] + other[k];
        const mirror = (2 * quantum - k) % (2 * quantum);
        if (k > 0 && k < quantum) {
          re[mirror] = one[k] + other[bins + k];
          im[mirror] = other[k] - one[bins + k];
        }
      }
      inverse(re, im);
      for (let i = 0; i < quantum; i++) {
        write(channel, i, re[quantum + i]);
        write(channel + 1, i, im[quantum + i]);
      }
    }
  }
}

/** Adds the product of two spectra to a third, all of them real parts and then imaginary ones. */
function multiplyAdd(heard, spectra, at, sum, bins) {
  for (let k = 0; k < bins; k++) {
    const a = heard[k];
    const b = heard[bins + k];
    const c = spectra[at + k];
    const d = spectra[at + bins + k];
    sum[k] += a * c - b * d;
    sum[bins + k] += a * d + b * c;
  }
}

/**
 * Direct sound along a path {delay, filter, gains}: samples from emitter to listener, a filter (Float64Array, always of one length), and how
 * much of it is in each channel.
 */
export class DirectSound {
  #quantum;
  #line; // a ring of the input
  #written = 0;
  #sinc = sincTable();
  #jump;
  #row; // delayed samples: those that the filter reaches back to, then the newest quantum
  #other;
  #now = null;
  #next = null; // becomes the present path
  #waiting = null; // the newest after that
  #done = 0; // quanta of the glide

  constructor({ quantum, sampleRate, longestS, taps }) {
    this.#quantum = quantum;
    this.#jump = JUMP_S * sampleRate;
    this.#line = new Float32Array(Math.ceil(longestS * sampleRate) + 2 * quantum + taps + 2 * SINC_TAPS);
    [this.#row, this.#other] = [new Float64Array(quantum + taps - 1), new Float64Array(quantum + taps - 1)];
  }

  /** The path from now on. */
  follow(path) {
    this.#waiting = path;
  }

  process(input, outputs) {
    const { length } = this.#line;
    for (let i = 0; i < input.length; i++) this.#line[(this.#written + i) % length] = input[i];
    this.#written += input.length;
    if (!this.#next && this.#waiting) this.#begin();
    if (this.#now) this.#render(outputs);
  }

  #begin() {
    [this.#next, this.#waiting] = [this.#waiting, null];
    if (!this.#now) this.#now = { ...this.#next, gains: this.#next.gains.map(() => 0) };
    this.#done = 0;
  }

  #render(outputs) {
    const [quantum, now, next] = [this.#quantum, this.#now, this.#next];
    if (!next) {
      this.#read(this.#row, now.delay, now.delay, true);
      this.#add(this.#row, now, 1, 1, outputs);
      return;
    }
    const isJump = Math.abs(next.delay - now.delay) > this.#jump;
    const quanta = isJump ? 1 : GLIDE_QUANTA;
    const [from, to] = [this.#done / quanta, (this.#done + 1) / quanta];
    let into = this.#row;
    if (isJump) {
      this.#read(this.#row, now.delay, now.delay, true);
      into = this.#other;
      this.#read(into, next.delay, next.delay, false);
    } else {
      const apart = next.delay - now.delay;
      this.#read(this.#row, now.delay + from * apart, now.delay + to * apart, true);
    }
    this.#add(this.#row, now, 1 - from, 1 - to, outputs);
    this.#add(into, next, from, to, outputs);
    this.#done += 1;
    if (this.#done < quanta) return;
    if (isJump) [this.#row, this.#other] = [this.#other, this.#row];
    [this.#now, this.#next] = [next, null];
  }

  /** Writes delayed samples to the end of a row: a new quantum after what it has, or the whole of it. The delay goes from one to another. */
  #read(row, before, after, isNext) {
    const [quantum, line] = [this.#quantum, this.#line];
    if (isNext) row.copyWithin(0, quantum);
    const first = isNext ? row.length - quantum : 0;
    const step = (after - before) / quantum;
    for (let i = first; i < row.length; i++) {
      const number = i - (row.length - quantum); // of the quantum's samples; before it, negative
      const delay = Math.max(SINC_TAPS / 2, before + step * (number + 1));
      const at = this.#written - quantum + number - delay;
      const whole = Math.floor(at);
      const phase = (at - whole) * PHASES;
      const entry = Math.min(PHASES - 1, Math.floor(phase));
      const share = phase - entry;
      const [one, other] = [this.#sinc[entry], this.#sinc[entry + 1]];
      let sum = 0;
      for (let tap = 0; tap < SINC_TAPS; tap++) {
        const index = whole - BEFORE + tap;
        if (index >= 0) sum += (one[tap] + share * (other[tap] - one[tap])) * line[index % line.length];
      }
      row[i] = sum;
    }
  }

  /** Adds a filtered row to the outputs, with a gain that goes from one to another. */
  #add(row, { filter, gains }, from, to, outputs) {
    const quantum = this.#quantum;
    const start = row.length - quantum;
    const step = (to - from) / quantum;
    for (let i = 0; i < quantum; i++) {
      let sum = 0;
      for (let tap = 0; tap < filter.length; tap++) sum += filter[tap] * row[start + i - tap];
      sum *= from + step * (i + 1);
      for (let channel = 0; channel < CHANNELS; channel++) outputs[channel][i] += gains[channel] * sum;
    }
  }
}
