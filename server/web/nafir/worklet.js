// The AudioWorklet. It plays the blocks from the stream worker and reports levels and buffer statistics. Ambisonic blocks are turned and
// decoded after the buffer, so that a turn of the head is heard with the next quantum. It uses messages and no shared memory, so that the
// page needs no cross-origin isolation.

import { HeadDecoder } from "./ambisonics.js";
import { release } from "./channels.js";
import { JitterBuffer } from "./jitterbuffer.js";

const QUANTUM = 128; // samples that the Web Audio API processes at once
const BLOCK = 256; // samples of a live emitter that are sent at once
const REPORT_QUANTA = Math.round((0.027 * sampleRate) / QUANTUM);
const TAP_S = 12;

/** The playback of a stream of ambisonics of this order, or of two ears if it is null. `channels` are what its buffer gave last. */
function playing(order) {
  const decoder = order === null ? null : new HeadDecoder({ order, frames: QUANTUM });
  const count = decoder?.channels ?? 2;
  const channels = Array.from({ length: count }, () => new Float32Array(QUANTUM));
  return { decoder, channels, buffer: new JitterBuffer({ sampleRate, channels: count }) };
}

/** Fills both ears from a playback. Returns the poses that become audible. */
function pull({ buffer, decoder, channels }, left, right) {
  if (!decoder) return buffer.pull([left, right]);
  const heard = buffer.pull(channels);
  decoder.decode(channels, left, right);
  return heard;
}

class NafirPlayer extends AudioWorkletProcessor {
  constructor() {
    super();
    this.present = playing(null); // the stream that is heard
    this.next = null; // one that is heard as soon as its buffer is filled
    this.filters = null; // of the head; {filters, delaySamples}
    this.orientation = [0, 0, 0, 1];
    this.turns = []; // {id, at, saidAt}: turns that the next quantum is the first to have
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
      this.present.buffer.isEnding = this.present.buffer.started; // what is left of it came through another port
      this.feed.onmessage = ({ data: block }) => (block.restart ? this.#restart(block.order) : this.#take(block));
    } else if (data.type === "end") {
      this.isOpen = false;
      this.feed?.close();
    } else if (data.type === "capture") {
      this.#capture(data);
    } else if (data.type === "head") {
      this.filters = data;
      for (const { decoder } of this.#streams) decoder?.use(data.filters);
    } else if (data.type === "turn") {
      this.orientation = data.orientation;
      for (const { decoder } of this.#streams) decoder?.turn(data.orientation);
      this.turns.push(data);
    }
  }

  get #streams() {
    return this.next ? [this.present, this.next] : [this.present];
  }

  /** Makes ready for a stream of ambisonics of this order, or of two ears if it is null. What is there of the present one is played until
      the next has filled its buffer. */
  #restart(order) {
    this.present.buffer.isEnding = true;
    this.next = playing(order);
    this.next.decoder?.turn(this.orientation);
    if (this.filters) this.next.decoder?.use(this.filters.filters);
  }

  #take(block) {
    (this.next ?? this.present).buffer.push(block);
    release(block.channels);
  }

  /** Fills both ears. Returns the poses that become audible. */
  #pull(left, right) {
    const { buffer } = this.next ?? this.present;
    if (!this.next || buffer.fill < buffer.target) return pull(this.present, left, right);
    const last = [new Float32Array(QUANTUM), new Float32Array(QUANTUM)];
    pull(this.present, ...last);
    for (const [name, count] of Object.entries(this.present.buffer.counters)) buffer.counters[name] += count;
    [this.present, this.next] = [this.next, null];
    const heard = pull(this.present, left, right);
    [left, right].forEach((samples, ear) => {
      for (let i = 0; i < QUANTUM; i++) samples[i] += last[ear][i] * (0.5 + 0.5 * Math.cos((Math.PI * (i + 0.5)) / QUANTUM));
    });
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
    this.#tellTurns();
    // Poses of a stream that ends are not those of the next, which counts its own.
    for (const { offset, fill, ...poses } of this.present.buffer.isEnding ? [] : heard) {
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
    if (!this.present.decoder || !this.present.buffer.playing) return;
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
    const { buffer } = this.present;
    this.port.postMessage({
      type: "report",
      time: currentTime,
      fillS: buffer.fill / sampleRate,
      targetS: buffer.target / sampleRate,
      playing: buffer.playing && !buffer.isEnding,
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
