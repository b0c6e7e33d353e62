// The reverberation of a field as ambisonic channels: frozen noises in octave bands, mixed with gains that follow what the network
// predicts. The arithmetic is the server's own (server/field/ambisonic_decoder.py, ambisonic_kernel.py).
//
// Predictions are logMagnitude[band * columns + column] of what an ideal omnidirectional microphone hears, and
// directions[(k * bands + band) * columns + column], the harmonics of its power from the second on.

import { OCTAVE_BANDS_HZ } from "./floor_plan.js";
import { inverse, transform } from "./fourier.js";
import { bandWeights } from "./plane_waves.js";

const BANDS = OCTAVE_BANDS_HZ.length;
const SWEEPS = 5;
const TINY = 1e-20;
const MOST_WAVE_MOMENTS = 8;

/** Numbers of the codec of a manifest that are not given in it. */
export function codecOf({ n_fft: window, hop, samples, frame_cells: cells = null }) {
  const firstFrame = 1 - Math.ceil((window - Math.floor(window / 2)) / hop);
  const reached = Math.ceil((samples - 1 + Math.floor(window / 2)) / hop);
  const frames = Math.max(reached, Math.floor(samples / hop) + 1) - firstFrame;
  const lead = Math.floor(window / 2) - firstFrame * hop;
  let edge = 0;
  const places = (cells ?? new Array(frames).fill(1)).map((width) => {
    const centre = (2 * edge + width - 1) / 2;
    edge += width;
    return centre * hop - lead + window / 2;
  });
  let energy = 0;
  for (let n = 0; n < window; n++) energy += (0.5 - 0.5 * Math.cos((2 * Math.PI * n) / window)) ** 2;
  return { frames, lead, places, windowEnergy: energy };
}

/** [noise][band] of white noises (Float32Array each): their octave bands, whose amplitudes add up to one. */
export function filterNoises(noises, sampleRate, windowEnergy) {
  const { length } = noises[0];
  const weights = Array.from({ length }, (_, i) => bandWeights((Math.min(i, length - i) * sampleRate) / length));
  const scale = 1 / Math.sqrt(windowEnergy);
  return noises.map((noise) => {
    const [re, im] = [Float64Array.from(noise, (sample) => sample * scale), new Float64Array(length)];
    transform(re, im);
    const bands = [];
    // Two real signals at a time: one in the real part, one in the imaginary part.
    for (let band = 0; band < BANDS; band += 2) {
      const [a, b] = [new Float64Array(length), new Float64Array(length)];
      for (let i = 0; i < length; i++) {
        const [one, other] = [weights[i][band], weights[i][band + 1] ?? 0];
        a[i] = one * re[i] - other * im[i];
        b[i] = one * im[i] + other * re[i];
      }
      inverse(a, b);
      bands.push(Float32Array.from(a));
      if (band + 1 < BANDS) bands.push(Float32Array.from(b));
    }
    return bands;
  });
}

/** Writes the second moments of the smoothest sound that has these first ones (Levermore, J. Quant. Spectrosc. Radiat. Transf. 31, 149, 1984). */
function smoothest(moments) {
  const [y, z, x] = moments;
  const square = Math.min(1, x * x + y * y + z * z);
  const ahead = (3 + 4 * square) / (5 + 2 * Math.sqrt(4 - 3 * square));
  const scale = (3 * ahead - 1) / 2 / Math.max(square, 1e-12);
  const root = Math.sqrt(3);
  moments[3] = scale * root * x * y;
  moments[4] = scale * root * y * z;
  moments[5] = scale * 0.5 * (2 * z * z - x * x - y * y);
  moments[6] = scale * root * x * z;
  moments[7] = scale * 0.5 * root * (x * x - y * y);
}

const covariance = new Float64Array(9);
const axes = new Float64Array(9);

/** Turns a pair of axes so that nothing is left between them, by Jacobi's method. */
function turnAxes(i, j, other) {
  const between = covariance[3 * i + j];
  const apart = covariance[4 * j] - covariance[4 * i];
  const length = Math.abs(apart) + Math.sqrt(apart * apart + 4 * between * between);
  const tangent = ((apart < 0 ? -2 : 2) * between) / Math.max(length, TINY);
  const cosine = 1 / Math.sqrt(tangent * tangent + 1);
  const sine = tangent * cosine;
  covariance[4 * i] -= tangent * between;
  covariance[4 * j] += tangent * between;
  covariance[3 * i + j] = covariance[3 * j + i] = 0;
  const a = covariance[3 * i + other];
  const b = covariance[3 * j + other];
  covariance[3 * i + other] = covariance[3 * other + i] = cosine * a - sine * b;
  covariance[3 * j + other] = covariance[3 * other + j] = sine * a + cosine * b;
  for (let k = 0; k < 3; k++) {
    const u = axes[3 * i + k];
    const v = axes[3 * j + k];
    axes[3 * i + k] = cosine * u - sine * v;
    axes[3 * j + k] = sine * u + cosine * v;
  }
}

const shares = new Float64Array(3);

/**
 * Writes to mixing[4 * i + j] how much of noise j is in channel i, for unit power, from the moments of the arriving power, harmonics from the
 * second on. W is its noise; Y, Z and X have a share of it, and of their own noises the symmetric root of what is left of their covariance.
 */
function firstOrder(moments, mixing) {
  const shrunk = 1 / Math.sqrt(Math.max(1, moments[0] ** 2 + moments[1] ** 2 + moments[2] ** 2));
  for (let i = 0; i < 3; i++) shares[i] = moments[i] * shrunk;
  const third = 1 / Math.sqrt(3);
  const zz = (2 * moments[5] + 1) / 3;
  const level = (1 - zz) / 2;
  const apart = third * moments[7];
  covariance[0] = level - apart;
  covariance[4] = zz;
  covariance[8] = level + apart;
  covariance[1] = covariance[3] = third * moments[4];
  covariance[2] = covariance[6] = third * moments[3];
  covariance[5] = covariance[7] = third * moments[6];
  for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) covariance[3 * i + j] -= shares[i] * shares[j];
  const leftOver = Math.max(0, covariance[0] + covariance[4] + covariance[8]);
  axes.fill(0);
  axes[0] = axes[4] = axes[8] = 1;
  for (let sweep = 0; sweep < SWEEPS; sweep++) {
    turnAxes(0, 1, 2);
    turnAxes(0, 2, 1);
    turnAxes(1, 2, 0);
  }
  let positive = 0;
  for (let i = 0; i < 3; i++) positive += Math.max(0, covariance[4 * i]);
  const scale = positive > TINY ? leftOver / positive : 0;
  mixing.fill(0);
  mixing[0] = 1;
  for (let i = 0; i < 3; i++) mixing[4 * (i + 1)] = shares[i];
  for (let axis = 0; axis < 3; axis++) {
    const size = Math.sqrt(Math.max(0, covariance[4 * axis]) * scale);
    for (let i = 0; i < 3; i++) {
      for (let j = 0; j < 3; j++) mixing[4 * (i + 1) + j + 1] += size * axes[3 * axis + i] * axes[3 * axis + j];
    }
  }
}

/** Adds samples `at` to `stop` of the bands of a noise, each with a gain that grows by a slope. All bands at once, so that a sample is
    written once. */
function addBands(to, [a, b, c, d, e, f, g], gains, slopes, at, stop) {
  let [g0, g1, g2, g3, g4, g5, g6] = gains;
  const [s0, s1, s2, s3, s4, s5, s6] = slopes;
  for (let n = at; n < stop; n++) {
    to[n] += g0 * a[n] + g1 * b[n] + g2 * c[n] + g3 * d[n] + g4 * e[n] + g5 * f[n] + g6 * g[n];
    g0 += s0;
    g1 += s1;
    g2 += s2;
    g3 += s3;
    g4 += s4;
    g5 += s5;
    g6 += s6;
  }
}

const lacking = (one, other) => {
  const squares = one * one + other * other;
  return squares > 0 ? (1.5 * squares) / (squares + one * other) : 1;
};

/** The factor by which a band's gain makes up for what is lacking between bands, where amplitudes add up and not powers. */
const balance = (before, gain, after) => Math.sqrt(0.5 * (lacking(before, gain) + lacking(gain, after)));

export class BandNoises {
  #codec;
  #noises; // [noise][band]
  #parameters;
  #end; // sample before which responses fade out, or null

  /** `noises` are white ones of unit variance, one for each channel (one or four); `frames` limits how many frames are heard. */
  constructor(parameters, noises, frames = null) {
    this.#parameters = parameters;
    this.#codec = codecOf(parameters);
    this.#noises = filterNoises(noises, parameters.sample_rate, this.#codec.windowEnergy);
    const { n_fft: window, hop } = parameters;
    this.#end = frames !== null && frames < this.#codec.frames ? (frames - 1) * hop - this.#codec.lead + window : null;
  }

  get columns() {
    return this.#codec.places.length;
  }

  /** Channels (Float32Array each, of `samples`) of a prediction whose first sample lies at `aligned`. */
  decode({ logMagnitude, directions }, aligned, samples) {
    const channels = this.#noises.map(() => new Float32Array(samples));
    const gains = this.#gains(logMagnitude, directions);
    const places = this.#codec.places.map((place) => place + aligned);
    const begin = Math.floor(places[0]) - this.#parameters.hop;
    const last = places.length - 1;
    const end = Math.min(samples, this.#noises[0][0].length);
    for (let at = Math.max(0, begin), column = -1; at < end; ) {
      while (column < last && places[column + 1] <= at) column++;
      const stop = column === last ? end : Math.min(end, Math.ceil(places[column + 1]));
      const [low, high] = [Math.max(column, 0), Math.min(column + 1, last)];
      const since = column >= 0 ? places[low] : begin;
      const apart = places[high] - since;
      this.#mix(gains, column < 0 ? -1 : low, high, apart > 0 ? (at - since) / apart : 0, apart > 0 ? 1 / apart : 0, at, stop, channels);
      at = stop;
    }
    if (this.#end !== null) this.#cut(channels, Math.trunc(this.#end + aligned));
    return channels;
  }

  /** Adds samples `at` to `stop`, with gains that go from those of column `low` (-1: none) towards those of column `high`. */
  #mix(gains, low, high, share, step, at, stop, channels) {
    const count = channels.length;
    const [first, slopes] = [new Float64Array(BANDS), new Float64Array(BANDS)];
    for (let i = 0; i < count; i++) {
      for (let j = 0; j < (i > 0 ? count : 1); j++) {
        const row = (i * count + j) * this.columns;
        for (let band = 0; band < BANDS; band++) {
          const before = low < 0 ? 0 : gains[(row + low) * BANDS + band];
          const rise = gains[(row + high) * BANDS + band] - before;
          first[band] = before + rise * share;
          slopes[band] = rise * step;
        }
        if (first.some(Boolean) || slopes.some(Boolean)) addBands(channels[i], this.#noises[j], first, slopes, at, stop);
      }
    }
  }

  /** [((channel * count + noise) * columns + column) * bands + band] */
  #gains(logMagnitude, directions) {
    const { columns } = this;
    const count = this.#noises.length;
    const gains = new Float64Array(count * count * columns * BANDS);
    const known = Math.min(MOST_WAVE_MOMENTS, directions.length / (BANDS * columns));
    const moments = new Float64Array(MOST_WAVE_MOMENTS);
    const mixing = new Float64Array(count * count).fill(1);
    for (let column = 0; column < columns; column++) {
      const magnitude = (band) => Math.max(0, Math.exp(logMagnitude[band * columns + column]) - this.#parameters.log_floor);
      let before = magnitude(0);
      for (let band = 0; band < BANDS; band++) {
        const own = magnitude(band);
        const gain = own * balance(before, own, magnitude(Math.min(band + 1, BANDS - 1)));
        before = own;
        if (count > 1) {
          for (let k = 0; k < known; k++) moments[k] = directions[(k * BANDS + band) * columns + column];
          moments.fill(0, known);
          if (known < MOST_WAVE_MOMENTS) smoothest(moments);
          firstOrder(moments, mixing);
        }
        for (let pair = 0; pair < mixing.length; pair++) gains[(pair * columns + column) * BANDS + band] = gain * mixing[pair];
      }
    }
    return gains;
  }

  #cut(channels, end) {
    const length = this.#parameters.n_fft - this.#parameters.hop;
    for (const channel of channels) {
      for (let n = Math.max(0, end - length); n < channel.length; n++) {
        channel[n] *= Math.sin((Math.PI / 2) * Math.min(1, Math.max(0, (end - n) / length))) ** 2;
      }
    }
  }
}
