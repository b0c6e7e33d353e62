// The AudioWorklet. It plays the blocks from the stream worker and reports levels and buffer statistics. It uses messages and no shared
// memory, so that the page needs no cross-origin isolation.

import { JitterBuffer } from "./jitterbuffer.js";

const REPORT_QUANTA = 5; // about 27 ms at 24 kHz
const TAP_S = 12;

class NafirPlayer extends AudioWorkletProcessor {
  constructor() {
    super();
    this.buffer = new JitterBuffer({ sampleRate });
    this.tap = [new Float32Array(TAP_S * sampleRate), new Float32Array(TAP_S * sampleRate)];
    this.tapped = 0; // samples written to the tap since the start
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
      this.feed.onmessage = ({ data: block }) => (block === "restart" ? this.buffer.reset() : this.buffer.push(block));
    } else if (data.type === "capture") {
      this.#capture(data);
    }
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
    const heard = this.buffer.pull(output[0], output[1]);
    for (const { offset, fill, ...poses } of heard) {
      this.port.postMessage({ type: "heard", ...poses, time: currentTime + offset / sampleRate, bufferedS: fill / sampleRate });
    }
    output.forEach((samples, ear) => this.#measure(samples, ear));
    this.tapped += output[0].length;
    this.quanta += 1;
    if (this.quanta === REPORT_QUANTA) this.#report(output[0].length);
    return true;
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

registerProcessor("nafir-player", NafirPlayer);
