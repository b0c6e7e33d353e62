// What emitters play into a scene that is rendered here, as mono samples: a clip from its beginning, or live sound as it arrives.

const MOST_LIVE_S = 0.5; // of live sound that waits; what is older is dropped
const BEGINS_WITH = 2; // blocks of live sound that wait before it is played, so that it does not run out at once

export class ClipSource {
  #samples;
  #loop;
  #at = 0;

  /** `samples` (Float32Array) may be null until they are there. */
  constructor(samples, loop = true) {
    this.samples = samples;
    this.#loop = loop;
  }

  set samples(samples) {
    this.#samples = samples;
  }

  /** Whether there is something to play. */
  get isReady() {
    return this.#samples !== null;
  }

  read(block) {
    block.fill(0);
    const samples = this.#samples;
    if (!samples || samples.length === 0) return;
    for (let i = 0; i < block.length; i++) {
      if (this.#at >= samples.length) {
        if (!this.#loop) return;
        this.#at = 0;
      }
      block[i] = samples[this.#at++];
    }
  }
}

export class LiveSource {
  isReady = true;
  #waiting = []; // arrays of samples
  #read = 0; // samples that are read of the first
  #count = 0;
  #most;
  #runs = false;

  constructor(sampleRate) {
    this.#most = MOST_LIVE_S * sampleRate;
  }

  feed(samples) {
    this.#waiting.push(samples);
    this.#count += samples.length;
    while (this.#count > this.#most) this.#drop();
  }

  #drop() {
    this.#count -= this.#waiting.shift().length - this.#read;
    this.#read = 0;
  }

  read(block) {
    block.fill(0);
    if (!this.#runs && this.#count < BEGINS_WITH * block.length) return;
    this.#runs = this.#count >= block.length;
    for (let i = 0; i < block.length && this.#count > 0; ) {
      const [first] = this.#waiting;
      const taken = Math.min(block.length - i, first.length - this.#read);
      block.set(first.subarray(this.#read, this.#read + taken), i);
      i += taken;
      this.#read += taken;
      this.#count -= taken;
      if (this.#read === first.length) {
        this.#waiting.shift();
        this.#read = 0;
      }
    }
  }
}
