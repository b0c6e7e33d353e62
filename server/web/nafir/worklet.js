// The AudioWorklet. It plays the blocks from the stream worker and reports levels and buffer statistics. Ambisonic blocks are turned and
// decoded after the buffer, so that a turn of the head is heard with the next quantum. It uses messages and no shared memory, so that the
// page needs no cross-origin isolation.

import { HeadDecoder } from "./ambisonics.js";
import { JitterBuffer } from "./jitterbuffer.js";

const QUANTUM = 128; // samples that the Web Audio API processes at once
const BLOCK = 256; // samples of a live emitter that are sent at once
const REPORT_QUANTA = 5; // about 27 ms at 24 kHz
const TAP_S = 12;

class NafirPlayer extends AudioWorkletProcessor {
  constructor() {
    super();
    this.buffer = new JitterBuffer({ sampleRate });
    this.channels = null; // what the buffer gave last, of an ambisonic stream
    this.decoder = null; // of an ambisonic stream
    this.filters = null; // of the head; {filters, delaySamples}
    this.orientation = [0, 0, 0, 1];
    this.turns = []; // {id, at, saidAt}: turns that the next quantum is the first to have
    this.ending = null; // last quantum of a stream that had other channels
    this.tap = [new Float32Array(TAP_S * sampleRate), new Float32Array(TAP_S * sampleRate)];
    this.tapped = 0; // samples written to the tap since the start
    this.isOpen = true;
    this.feed = null; // port of the stream worker
    this.quanta = 0;
    this.peak = [0, 0];
    this.power = [0, 0];
    this.port.onmessage = ({ data }) => this.#obey(data);
  }

  #obey(data) {
    if (data.type === "connect") {
      this.feed?.close();
      this.feed = data.port;
      this.feed.onmessage = ({ data: block }) => (block.restart ? this.#restart(block.order) : this.buffer.push(block));
    } else if (data.type === "end") {
      this.isOpen = false;
      this.feed?.close();
    } else if (data.type === "capture") {
      this.#capture(data);
    } else if (data.type === "head") {
      this.filters = data;
      this.decoder?.use(data.filters);
    } else if (data.type === "turn") {
      this.orientation = data.orientation;
      this.decoder?.turn(data.orientation);
      this.turns.push(data);
    }
  }

  /** Makes ready for a stream of ambisonics of this order, or of two ears if it is null. */
  #restart(order) {
    if (order === (this.decoder?.order ?? null)) {
      this.buffer.reset();
      return;
    }
    const { counters } = this.buffer;
    this.buffer.reset();
    this.ending = [new Float32Array(QUANTUM), new Float32Array(QUANTUM)];
    this.#pull(...this.ending);
    this.decoder = order === null ? null : new HeadDecoder({ order, frames: QUANTUM });
    const channels = this.decoder?.channels ?? 2;
    this.channels = Array.from({ length: channels }, () => new Float32Array(QUANTUM));
    this.buffer = new JitterBuffer({ sampleRate, channels });
    Object.assign(this.buffer.counters, counters);
    if (!this.decoder) return;
    this.decoder.turn(this.orientation);
    if (this.filters) this.decoder.use(this.filters.filters);
  }

  /** Fills both ears. Returns the poses that become audible. */
  #pull(left, right) {
    if (!this.decoder) return this.buffer.pull([left, right]);
    const heard = this.buffer.pull(this.channels);
    this.decoder.decode(this.channels, left, right);
    return heard;
  }

  /** The last `seconds` that were played, before the volume control. */
  #capture({ id, seconds }) {
    const frames = Math.min(this.tapped, this.tap[0].length, Math.round(seconds * sampleRate));
    const ears = this.tap.map((ring) => {
      const copy = new Float32Array(frames);
      for (let i = 0; i < frames; i++) copy[i] = ring[(this.tapped - frames + i) % ring.length];
      return copy;
    });
    const [left, right] = ears;
    this.port.postMessage({ type: "captured", id, left, right }, [left.buffer, right.buffer]);
  }

  process(_inputs, [output]) {
    const heard = this.#pull(output[0], output[1]);
    if (this.ending) output.forEach((samples, ear) => samples.forEach((_, i) => (samples[i] += this.ending[ear][i])));
    this.ending = null;
    this.#tellTurns();
    for (const { offset, fill, ...poses } of heard) {
      this.port.postMessage({ type: "heard", ...poses, time: currentTime + offset / sampleRate, bufferedS: fill / sampleRate });
    }
    output.forEach((samples, ear) => this.#measure(samples, ear));
    this.tapped += output[0].length;
    this.quanta += 1;
    if (this.quanta === REPORT_QUANTA) this.#report(output[0].length);
    return this.isOpen;
  }

  /** Says which turns of the head this quantum is the first to have. */
  #tellTurns() {
    if (this.turns.length === 0) return;
    const turns = this.turns;
    this.turns = [];
    if (!this.decoder || !this.buffer.playing) return;
    const time = currentTime + (this.filters?.delaySamples ?? 0) / sampleRate;
    const now = Date.now();
    this.port.postMessage({ type: "turned", time, turns: turns.map(({ at, saidAt }) => ({ at, heldMs: Math.max(0, now - saidAt) })) });
  }

  #measure(samples, ear) {
    const ring = this.tap[ear];
    for (let i = 0; i < samples.length; i++) {
      const value = samples[i];
      ring[(this.tapped + i) % ring.length] = value;
      this.power[ear] += value * value;
      if (value > this.peak[ear]) this.peak[ear] = value;
      else if (-value > this.peak[ear]) this.peak[ear] = -value;
    }
  }

  #report(frames) {
    const { buffer } = this;
    this.port.postMessage({
      type: "report",
      time: currentTime,
      fillS: buffer.fill / sampleRate,
      targetS: buffer.target / sampleRate,
      playing: buffer.playing,
      started: buffer.started,
      peak: [...this.peak],
      rms: this.power.map((power) => Math.sqrt(power / (REPORT_QUANTA * frames))),
      counters: { ...buffer.counters },
    });
    this.quanta = 0;
    this.peak.fill(0);
    this.power.fill(0);
  }
}

/** Takes the sound of a live emitter: the mean of its channels, a block at a time, to a port that it is given. */
class NafirTap extends AudioWorkletProcessor {
  constructor() {
    super();
    this.block = new Float32Array(BLOCK);
    this.filled = 0;
    this.to = null;
    this.isOpen = true;
    this.port.onmessage = ({ data }) => {
      this.to?.close();
      this.to = data.port ?? null;
      this.isOpen = this.to !== null;
    };
  }

  process([channels]) {
    // Without anything connected there are no channels, and nothing is sent: silence would cost as much as sound.
    if (channels.length > 0) this.#take(channels);
    return this.isOpen;
  }

  #take(channels) {
    for (let i = 0; i < channels[0].length; i++) {
      let sum = 0;
      for (const samples of channels) sum += samples[i];
      this.block[this.filled++] = sum / channels.length;
      if (this.filled < BLOCK) continue;
      this.to?.postMessage(this.block, [this.block.buffer]);
      this.block = new Float32Array(BLOCK);
      this.filled = 0;
    }
  }
}

registerProcessor("nafir-player", NafirPlayer);
registerProcessor("nafir-tap", NafirTap);
