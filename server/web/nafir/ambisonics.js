// Ambisonic sound (AmbiX: ACN order, SN3D norm) turned by the orientation of a head and decoded to its two ears. It does no I/O, so that
// the worklet and tests can drive it.
//
// Directions are unit vectors [x, y, z] (x ahead, y left, z up), orientations quaternions [x, y, z, w]. Channel 0 is heard alike from
// everywhere, the next three are y, z and x.

/** Real spherical harmonics of a direction up to order 1, 2 or 3, one for each channel. */
export function realHarmonics([x, y, z], order) {
  const root = Math.sqrt(3);
  const [outer, inner, middle] = [Math.sqrt(5 / 8), Math.sqrt(3 / 8), Math.sqrt(15)];
  const harmonics = [
    1, y, z, x,
    root * x * y, root * y * z, 0.5 * (3 * z * z - 1), root * x * z, 0.5 * root * (x * x - y * y),
    outer * y * (3 * x * x - y * y), middle * x * y * z, inner * y * (5 * z * z - 1), 0.5 * z * (5 * z * z - 3),
    inner * x * (5 * z * z - 1), 0.5 * middle * z * (x * x - y * y), outer * x * (x * x - 3 * y * y),
  ];
  return harmonics.slice(0, (order + 1) ** 2);
}

const degreeOf = (channel) => Math.floor(Math.sqrt(channel));

/** Directions and weights whose weighted sum is the mean over the sphere of every polynomial up to degree 7 (Lebedev 1976): products of
    two harmonics of order 3 have degree 6. */
const SAMPLED = [];
for (const x of [-1, 0, 1]) {
  for (const y of [-1, 0, 1]) {
    for (const z of [-1, 0, 1]) {
      const length = Math.hypot(x, y, z);
      const weight = [0, 1 / 21, 4 / 105, 9 / 280][Math.round(length ** 2)]; // of faces, edges and corners of a cube
      if (length > 0) SAMPLED.push({ direction: [x / length, y / length, z / length], weight });
    }
  }
}

/** A direction in world axes, in the axes of a head with this orientation. */
function inHead([qx, qy, qz, qw], [x, y, z]) {
  return [
    (1 - 2 * (qy * qy + qz * qz)) * x + 2 * (qx * qy + qz * qw) * y + 2 * (qx * qz - qy * qw) * z,
    2 * (qx * qy - qz * qw) * x + (1 - 2 * (qx * qx + qz * qz)) * y + 2 * (qy * qz + qx * qw) * z,
    2 * (qx * qz + qy * qw) * x + 2 * (qy * qz - qx * qw) * y + (1 - 2 * (qx * qx + qy * qy)) * z,
  ];
}

/** The matrix, row by row, from channels in world axes to those in the axes of a head with this orientation. */
export function rotation(orientation, order) {
  const channels = (order + 1) ** 2;
  const matrix = new Float64Array(channels * channels);
  for (const { direction, weight } of SAMPLED) {
    const before = realHarmonics(direction, order);
    const after = realHarmonics(inHead(orientation, direction), order);
    for (let row = 0; row < channels; row++) {
      const degree = degreeOf(row);
      for (let column = degree ** 2; column < (degree + 1) ** 2; column++) {
        matrix[row * channels + column] += (2 * degree + 1) * weight * after[row] * before[column];
      }
    }
  }
  return matrix;
}

/** Gains of the first channels for cardioids to the left and to the right, of the level that a head has in diffuse sound. */
const CARDIOIDS = [1, -1].map((side) => [Math.sqrt(3) / 2, (side * Math.sqrt(3)) / 2]);

export class HeadDecoder {
  #matrix;
  #wanted;
  #rows; // of each channel, the newest samples in the axes of the head, after those that the filters still reach back to
  #filters; // of each ear, one for each channel
  #newFilters = null;
  #frames;

  /** Decodes `frames` samples at a time, a multiple of four, as two cardioid microphones would hear until it has the filters of a head. */
  constructor({ order, frames }) {
    this.order = order;
    this.channels = (order + 1) ** 2;
    this.#frames = frames;
    this.#matrix = this.#wanted = rotation([0, 0, 0, 1], order);
    this.#rows = Array.from({ length: this.channels }, () => new Float64Array(frames));
    this.#filters = CARDIOIDS.map((gains) => this.#rows.map((_, channel) => Float64Array.of(gains[channel] ?? 0)));
  }

  /** Turns the head to an orientation, in the course of the next samples. */
  turn(orientation) {
    this.#wanted = rotation(orientation, this.order);
  }

  /** Listens with the head that has these filters[ear][channel] (arrays of one length), from the next samples on. */
  use(filters) {
    this.#newFilters = filters.map((ear) => ear.map((filter) => Float64Array.from(filter)));
    const reach = Math.max(filters[0][0].length, this.#reach) - 1;
    this.#rows = this.#rows.map((row) => {
      const longer = new Float64Array(reach + this.#frames);
      const kept = row.subarray(Math.max(0, row.length - longer.length));
      longer.set(kept, longer.length - kept.length);
      return longer;
    });
  }

  get #reach() {
    return this.#rows[0].length - this.#frames + 1;
  }

  /** Decodes channels (Float32Array each, in world axes) to both ears. */
  decode(channels, left, right) {
    this.#rotate(channels);
    left.fill(0);
    right.fill(0);
    this.#filter(this.#filters, left, right);
    if (this.#newFilters) {
      this.#filters = this.#newFilters;
      this.#newFilters = null;
      const after = [new Float32Array(this.#frames), new Float32Array(this.#frames)];
      this.#filter(this.#filters, ...after);
      [left, right].forEach((ear, index) => {
        for (let i = 0; i < ear.length; i++) ear[i] += ((i + 1) / ear.length) * (after[index][i] - ear[i]);
      });
    }
  }

  /** Appends the channels to the rows, turned by a matrix that goes from the present one to the wanted one. */
  #rotate(channels) {
    const frames = this.#frames;
    const [from, to] = [this.#matrix, this.#wanted];
    for (let row = 0; row < this.channels; row++) {
      const samples = this.#rows[row];
      const start = samples.length - frames;
      samples.copyWithin(0, frames);
      samples.fill(0, start);
      const degree = degreeOf(row);
      for (let column = degree ** 2; column < (degree + 1) ** 2; column++) {
        const gain = from[row * this.channels + column];
        const step = (to[row * this.channels + column] - gain) / frames;
        if (gain === 0 && step === 0) continue;
        const channel = channels[column];
        for (let i = 0; i < frames; i++) samples[start + i] += (gain + step * (i + 1)) * channel[i];
      }
    }
    this.#matrix = to;
  }

  /** Adds what filters make of the rows: four samples of both ears at a time, so that each sample of a row is read once for eight sums. */
  #filter([forLeft, forRight], left, right) {
    this.#rows.forEach((row, channel) => {
      const [toLeft, toRight] = [forLeft[channel], forRight[channel]];
      const start = row.length - this.#frames;
      for (let i = 0; i < this.#frames; i += 4) {
        let [l0, l1, l2, l3] = [left[i], left[i + 1], left[i + 2], left[i + 3]];
        let [r0, r1, r2, r3] = [right[i], right[i + 1], right[i + 2], right[i + 3]];
        let [x1, x2, x3] = [row[start + i + 1], row[start + i + 2], row[start + i + 3]];
        for (let tap = 0; tap < toLeft.length; tap++) {
          const x0 = row[start + i - tap];
          const l = toLeft[tap];
          const r = toRight[tap];
          l0 += l * x0;
          l1 += l * x1;
          l2 += l * x2;
          l3 += l * x3;
          r0 += r * x0;
          r1 += r * x1;
          r2 += r * x2;
          r3 += r * x3;
          x3 = x2;
          x2 = x1;
          x1 = x0;
        }
        [left[i], left[i + 1], left[i + 2], left[i + 3]] = [l0, l1, l2, l3];
        [right[i], right[i + 1], right[i + 2], right[i + 3]] = [r0, r1, r2, r3];
      }
    });
  }
}
