// Discrete Fourier transforms of any length, in double precision. Powers of two are transformed directly, and other lengths as a
// convolution with a chirp (Bluestein, IEEE Trans. Audio Electroacoust. 18, 451, 1970).

const tables = new Map();

/** Cosines and sines of half a turn, and the order in which a transform of `size` points takes them. */
function tablesOf(size) {
  let found = tables.get(size);
  if (!found) {
    const bits = Math.log2(size);
    const [cosines, sines, order] = [new Float64Array(size / 2), new Float64Array(size / 2), new Uint32Array(size)];
    for (let i = 0; i < size / 2; i++) {
      cosines[i] = Math.cos((2 * Math.PI * i) / size);
      sines[i] = Math.sin((2 * Math.PI * i) / size);
    }
    for (let i = 1; i < size; i++) order[i] = (order[i >> 1] >> 1) | ((i & 1) << (bits - 1));
    found = { cosines, sines, order };
    tables.set(size, found);
  }
  return found;
}

/** Transforms re + i im in place; the length is a power of two. */
function transformPower(re, im) {
  const size = re.length;
  const { cosines, sines, order } = tablesOf(size);
  for (let i = 0; i < size; i++) {
    const j = order[i];
    if (j > i) {
      const real = re[i];
      const imaginary = im[i];
      re[i] = re[j];
      im[i] = im[j];
      re[j] = real;
      im[j] = imaginary;
    }
  }
  for (let half = 1; half < size; half *= 2) {
    const step = size / (2 * half);
    for (let start = 0; start < size; start += 2 * half) {
      for (let k = 0; k < half; k++) {
        const c = cosines[k * step];
        const s = sines[k * step];
        const a = start + k;
        const b = a + half;
        const x = re[b] * c + im[b] * s;
        const y = im[b] * c - re[b] * s;
        re[b] = re[a] - x;
        im[b] = im[a] - y;
        re[a] += x;
        im[a] += y;
      }
    }
  }
}

const chirps = new Map();

function chirpOf(length) {
  let found = chirps.get(length);
  if (!found) {
    let size = 1;
    while (size < 2 * length - 1) size *= 2;
    const [cosines, sines] = [new Float64Array(length), new Float64Array(length)];
    const [re, im] = [new Float64Array(size), new Float64Array(size)];
    for (let n = 0; n < length; n++) {
      // n * n modulo 2 * length, so that the angle keeps its precision.
      const angle = (Math.PI * ((n * n) % (2 * length))) / length;
      cosines[n] = re[n] = re[(size - n) % size] = Math.cos(angle);
      sines[n] = im[n] = im[(size - n) % size] = Math.sin(angle);
    }
    transformPower(re, im);
    found = { size, cosines, sines, re, im };
    chirps.set(length, found);
  }
  return found;
}

/** Transforms re + i im (Float64Array each, of any length) in place. */
export function transform(re, im) {
  const { length } = re;
  if ((length & (length - 1)) === 0) {
    transformPower(re, im);
    return;
  }
  const chirp = chirpOf(length);
  const [a, b] = [new Float64Array(chirp.size), new Float64Array(chirp.size)];
  for (let n = 0; n < length; n++) {
    a[n] = re[n] * chirp.cosines[n] + im[n] * chirp.sines[n];
    b[n] = im[n] * chirp.cosines[n] - re[n] * chirp.sines[n];
  }
  transformPower(a, b);
  // A transform of the conjugate is the conjugate of the transform backwards.
  for (let n = 0; n < chirp.size; n++) {
    const real = a[n] * chirp.re[n] - b[n] * chirp.im[n];
    b[n] = -(a[n] * chirp.im[n] + b[n] * chirp.re[n]);
    a[n] = real;
  }
  transformPower(a, b);
  for (let n = 0; n < length; n++) {
    const x = a[n] / chirp.size;
    const y = -b[n] / chirp.size;
    re[n] = x * chirp.cosines[n] + y * chirp.sines[n];
    im[n] = y * chirp.cosines[n] - x * chirp.sines[n];
  }
}

/** Transforms back, in place. */
export function inverse(re, im) {
  transform(im, re);
  for (let n = 0; n < re.length; n++) {
    re[n] /= re.length;
    im[n] /= re.length;
  }
}
