// Sound that arrives along paths that are known, as ambisonic channels: a delay of fractions of a sample, and a minimum-phase filter of what
// air and surfaces absorb. The arithmetic is the server's own (server/rendering/still_paths_kernel.py, server/acoustics/air.py).

import { inverse } from "./fourier.js";
import { OCTAVE_BANDS_HZ } from "./floor_plan.js";
import { realHarmonics } from "../ambisonics.js";

const NEAR_LIMIT_M = 0.25; // nearer sources are no louder
export const SINC_TAPS = 32;
export const BEFORE = SINC_TAPS / 2 - 1;
export const PHASES = 256;
const KAISER_BETA = 10;
const FILTER_S = 0.004;
const TAPS_MULTIPLE = 8;
/** The bands of filters: the last is known of the air alone, and surfaces are there as in the one below. */
const FILTER_BANDS_HZ = [...OCTAVE_BANDS_HZ, 16000];

/** Decibels per metre that air absorbs in each band of filters, by ISO 9613-1. */
export function absorptionDbPerM({ temperature_c: celsius = 20, relative_humidity: humidity = 0.5 } = {}) {
  const kelvin = celsius + 273.15;
  const warmth = kelvin / 293.15;
  const saturation = 10 ** (4.6151 - 6.8346 * (273.16 / kelvin) ** 1.261);
  const vapour = Math.min(100, 100 * humidity * saturation);
  const oxygenHz = 24 + (4.04e4 * vapour * (0.02 + vapour)) / (0.391 + vapour);
  const nitrogenHz = (9 + 280 * vapour * Math.exp(-4.17 * (warmth ** (-1 / 3) - 1))) / warmth ** 0.5;
  return FILTER_BANDS_HZ.map((frequency) => {
    const classical = 1.84e-11 * warmth ** 0.5;
    const oxygen = (0.01275 * Math.exp(-2239.1 / kelvin)) / (oxygenHz + frequency ** 2 / oxygenHz);
    const nitrogen = (0.1068 * Math.exp(-3352 / kelvin)) / (nitrogenHz + frequency ** 2 / nitrogenHz);
    return 8.686 * frequency ** 2 * (classical + warmth ** -2.5 * (oxygen + nitrogen));
  });
}

/** Weights of a frequency in bands an octave apart, linear over the logarithm of frequency; they add up to one. */
export function bandWeights(frequency, centresHz = OCTAVE_BANDS_HZ) {
  const last = centresHz.length - 1;
  const octave = Math.min(last, Math.max(0, Math.log2(Math.max(frequency, 1) / centresHz[0])));
  return centresHz.map((_, band) => Math.max(0, 1 - Math.abs(octave - band)));
}

/** Solves matrix x = columns by elimination, in place; rows are arrays. */
function solve(matrix, right) {
  const size = matrix.length;
  for (let pivot = 0; pivot < size; pivot++) {
    let best = pivot;
    for (let row = pivot + 1; row < size; row++) if (Math.abs(matrix[row][pivot]) > Math.abs(matrix[best][pivot])) best = row;
    [matrix[pivot], matrix[best]] = [matrix[best], matrix[pivot]];
    [right[pivot], right[best]] = [right[best], right[pivot]];
    for (let row = 0; row < size; row++) {
      if (row === pivot) continue;
      const factor = matrix[row][pivot] / matrix[pivot][pivot];
      for (let k = pivot; k < size; k++) matrix[row][k] -= factor * matrix[pivot][k];
      for (let k = 0; k < right[row].length; k++) right[row][k] -= factor * right[pivot][k];
    }
  }
  right.forEach((row, pivot) => row.forEach((value, k) => (row[k] = value / matrix[pivot][pivot])));
}

/** [band][tap] folded cepstra of a gain of one decibel in each band of filters, exact at the centres of the bands. */
function bandCepstra(sampleRate, taps) {
  const nepers = Math.LN10 / 20;
  let size = 1;
  while (size < 64 * taps) size *= 2;
  const cepstra = FILTER_BANDS_HZ.map((_, band) => {
    const [re, im] = [new Float64Array(size), new Float64Array(size)];
    for (let i = 0; i <= size / 2; i++) re[i] = re[(size - i) % size] = nepers * bandWeights((i * sampleRate) / size, FILTER_BANDS_HZ)[band];
    inverse(re, im);
    return re.slice(0, taps).map((value, n) => (n === 0 ? value : 2 * value));
  });
  const audible = FILTER_BANDS_HZ.flatMap((centre, band) => (centre < sampleRate / 2 ? [band] : []));
  const atCentres = FILTER_BANDS_HZ.map((_, band) =>
    audible.map((other) => {
      const turn = (2 * Math.PI * FILTER_BANDS_HZ[other]) / sampleRate;
      return cepstra[band].reduce((sum, value, n) => sum + value * Math.cos(turn * n), 0) / nepers;
    }),
  );
  const mixed = audible.map((band) => cepstra[band]);
  solve(
    audible.map((band) => [...atCentres[band]]),
    mixed,
  );
  audible.forEach((band, i) => (cepstra[band] = mixed[i]));
  FILTER_BANDS_HZ.forEach((centre, band) => {
    if (centre < sampleRate / 2) return;
    mixed.forEach((ofBand, i) => ofBand.forEach((value, n) => (cepstra[band][n] -= atCentres[band][i] * value)));
  });
  return cepstra;
}

/** The modified Bessel function of order 0. */
export function besselI0(x) {
  let [term, sum] = [1, 1];
  for (let n = 1; term > 1e-17 * sum; n++) {
    term *= (x / (2 * n)) ** 2;
    sum += term;
  }
  return sum;
}

/** [tap] a sinc in a Kaiser window that reads a signal at a fraction of a sample after tap `taps / 2 - 1`. */
export function windowedSinc(fraction, taps, beta) {
  const row = Float64Array.from({ length: taps }, (_, tap) => {
    const offset = tap - (taps / 2 - 1) - fraction;
    const sinc = offset === 0 ? 1 : Math.sin(Math.PI * offset) / (Math.PI * offset);
    return sinc * besselI0(beta * Math.sqrt(Math.max(0, 1 - (offset / (taps / 2)) ** 2)));
  });
  const sum = row.reduce((total, value) => total + value, 0);
  return row.map((value) => value / sum);
}

/** [phase][tap] windowed sincs that read a signal between its samples; one phase more than PHASES, to interpolate to. */
export const sincTable = () => Array.from({ length: PHASES + 1 }, (_, phase) => windowedSinc(phase / PHASES, SINC_TAPS, KAISER_BETA));

export class PlaneWaves {
  #sampleRate;
  #speedOfSound;
  #airDbPerM;
  #cepstra;
  #sinc = sincTable();

  constructor({ sampleRate, speedOfSound, airDbPerM }) {
    this.#sampleRate = sampleRate;
    this.#speedOfSound = speedOfSound;
    this.#airDbPerM = airDbPerM;
    this.taps = Math.ceil(Math.round(FILTER_S * sampleRate) / TAPS_MULTIPLE) * TAPS_MULTIPLE;
    this.#cepstra = bandCepstra(sampleRate, this.taps);
  }

  /** The minimum-phase filter of a path: surfaces or edges (`gainDb`, per octave band), air, and distance. */
  filter({ lengthM, gainDb }) {
    const cepstrum = new Float64Array(this.taps);
    this.#cepstra.forEach((ofBand, band) => {
      const level = gainDb[Math.min(band, gainDb.length - 1)] - this.#airDbPerM[band] * lengthM;
      for (let n = 0; n < cepstrum.length; n++) cepstrum[n] += level * ofBand[n];
    });
    const filter = new Float64Array(this.taps);
    filter[0] = Math.exp(cepstrum[0]);
    for (let n = 1; n < filter.length; n++) {
      let sum = 0;
      for (let k = 1; k <= n; k++) sum += k * cepstrum[k] * filter[n - k];
      filter[n] = sum / n;
    }
    const gain = 1 / Math.max(lengthM, NEAR_LIMIT_M);
    return filter.map((tap) => gain * tap);
  }

  /** Adds a path ({lengthM, arrival, gainDb}) to channels (Float32Array each, four or one); sample 0 is the moment of emission. */
  add(path, channels) {
    const filter = this.filter(path);
    const delay = (path.lengthM / this.#speedOfSound) * this.#sampleRate;
    const whole = Math.ceil(delay);
    const phase = (whole - delay) * PHASES;
    const row = Math.min(PHASES - 1, Math.floor(phase));
    const [one, other] = [this.#sinc[row], this.#sinc[row + 1]];
    const still = one.map((tap, k) => tap + (phase - row) * (other[k] - tap));
    const begin = whole + BEFORE - (SINC_TAPS - 1);
    const harmonics = realHarmonics(path.arrival, Math.sqrt(channels.length) - 1);
    const samples = channels[0].length;
    for (let i = Math.max(0, -begin); i < filter.length + SINC_TAPS - 1 && begin + i < samples; i++) {
      let heard = 0;
      // The sinc runs backwards.
      for (let k = Math.max(0, i - filter.length + 1); k <= Math.min(i, SINC_TAPS - 1); k++) heard += still[SINC_TAPS - 1 - k] * filter[i - k];
      channels.forEach((channel, number) => (channel[begin + i] += heard * harmonics[number]));
    }
  }
}
