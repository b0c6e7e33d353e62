// Blocks in Opus, decoded by WebCodecs, and live sound on its way up, encoded by it. The browser does so when it likes, so what goes in
// comes out a little later, in order.

import { newChannels } from "./channels.js";

const RATE = 48_000; // at which browsers decode Opus, whatever it was made from
const MICROSECONDS = 1e6;
const MOST_WAITING_S = 0.5; // of live sound that is not encoded yet; what comes then is dropped
const APPLICATIONS = { low_delay: "lowdelay", audio: "audio", voip: "voip" };

/** Whether this browser decodes Opus to samples of this rate. */
export async function decodesOpus(sampleRate) {
  if (sampleRate !== RATE || !globalThis.AudioDecoder) return false;
  const { supported } = await AudioDecoder.isConfigSupported({ codec: "opus", sampleRate: RATE, numberOfChannels: 2 });
  return supported;
}

/** The decoder of one Opus stream of a block's channels: packets in, arrays of a channel's samples out, one answer for each packet. */
class PacketDecoder {
  #decoder;
  #waiting = []; // callbacks, one for each packet that has gone in
  #time = 0;
  #frames;
  #frameUs;
  #fail;

  constructor(channels, frames, fail) {
    this.#frames = frames;
    this.#fail = fail;
    this.#frameUs = (MICROSECONDS * frames) / RATE;
    this.#decoder = new AudioDecoder({ output: (data) => this.#answer(data), error: fail });
    this.#decoder.configure({ codec: "opus", sampleRate: RATE, numberOfChannels: channels });
  }

  decode(packet, answer) {
    this.#waiting.push(answer);
    this.#decoder.decode(new EncodedAudioChunk({ type: "key", timestamp: this.#time, duration: this.#frameUs, data: packet }));
    this.#time += this.#frameUs;
  }

  #answer(data) {
    const planes = Array.from({ length: data.numberOfChannels }, (_, planeIndex) => {
      const samples = new Float32Array(data.numberOfFrames);
      data.copyTo(samples, { planeIndex, format: "f32-planar" });
      return samples;
    });
    data.close();
    if (planes[0].length === this.#frames) this.#waiting.shift()(planes);
    else this.#fail(new TypeError(`a packet of ${this.#frames} samples was decoded to ${planes[0].length}`));
  }

  /** Gives the answers that are due, then ends. */
  async finish() {
    await this.#decoder.flush().catch(() => {}); // closed before by an error or by close
    this.close();
  }

  close() {
    if (this.#decoder.state !== "closed") this.#decoder.close();
  }
}

export class OpusReader {
  #streams;
  #frames;
  #lookAhead;
  #deliver;
  #fail;
  #decoders = [];
  #queue = []; // {block, channels, missing, dropped}: blocks whose packets are being decoded
  #unheard = 0; // samples still to be dropped after a restart

  /** `opus` is that of the welcome. `deliver` gets whole blocks, with channels; `fail` gets the error of a decoder, which ends the reader. */
  constructor(opus, deliver, fail) {
    this.#streams = opus.streams;
    this.#frames = opus.frame_samples;
    this.#lookAhead = opus.look_ahead;
    this.#deliver = deliver;
    this.#fail = fail;
  }

  /** Takes the next block: a parsed header, its packets, and whether decoders begin anew with it. */
  read(block, packets, isRestart) {
    if (isRestart) this.#restart();
    const count = this.#streams.length;
    if (packets.length % count !== 0) throw new TypeError(`audio block of ${packets.length} packets for ${count} streams`);
    const decoded = (packets.length / count) * this.#frames;
    const dropped = Math.min(decoded, this.#unheard);
    this.#unheard -= dropped;
    if (decoded - dropped !== block.frames) throw new TypeError(`audio block of ${block.frames} frames holds ${decoded - dropped}`);
    const parts = this.#streams.map(() => []);
    const entry = { block, parts, missing: packets.length, dropped };
    this.#queue.push(entry);
    packets.forEach((packet, index) => {
      const stream = index % count;
      this.#decoders[stream].decode(packet, (planes) => {
        parts[stream].push(planes);
        entry.missing -= 1;
        this.#deliverWhole();
      });
    });
    this.#deliverWhole();
  }

  #restart() {
    for (const decoder of this.#decoders) decoder.finish();
    this.#decoders = this.#streams.map((channels) => new PacketDecoder(channels, this.#frames, this.#fail));
    this.#unheard = this.#lookAhead;
  }

  #deliverWhole() {
    while (this.#queue.length > 0 && this.#queue[0].missing === 0) {
      const { block, parts, dropped } = this.#queue.shift();
      const planesOf = (stream, plane) => joined(parts[stream].map((planes) => planes[plane]), dropped);
      const planes = this.#streams.flatMap((count, stream) => Array.from({ length: count }, (_, plane) => planesOf(stream, plane)));
      if (planes.length === 1) planes.push(planes[0]); // a single channel is heard by both ears
      const channels = newChannels(planes.length, planes[0].length);
      planes.forEach((samples, channel) => channels[channel].set(samples));
      this.#deliver({ ...block, channels });
    }
  }

  close() {
    this.#queue = [];
    for (const decoder of this.#decoders) decoder.close();
  }
}

/** How a browser is to encode live sound as the server does a single channel: with half the bitrate of the stream's `options`. */
function encoding(frames, { bitrate = 128_000, complexity = 5, application = "low_delay", signal = "auto" } = {}) {
  const opus = { frameDuration: (MICROSECONDS * frames) / RATE, complexity, application: APPLICATIONS[application], signal };
  return { codec: "opus", sampleRate: RATE, numberOfChannels: 1, bitrate: bitrate / 2, opus };
}

/** Whether this browser encodes live sound of this rate in packets of so many samples. */
export async function encodesOpus(sampleRate, frames, options) {
  if (sampleRate !== RATE || !globalThis.AudioEncoder) return false;
  const answer = await AudioEncoder.isConfigSupported(encoding(frames, options)).catch(() => ({ supported: false }));
  return answer.supported;
}

/** Encodes the sound of a live emitter. */
export class OpusWriter {
  #encoder;
  #deliver;
  #frames;
  #written = 0; // samples
  #given = 0; // those of packets that have come out

  /** `frames` is the samples of a packet, `options` are those of the hello. `deliver` gets each packet; `fail` gets the error that ends the
      writer. */
  constructor({ frames, options, deliver, fail }) {
    this.#frames = frames;
    this.#deliver = deliver;
    this.#encoder = new AudioEncoder({ output: (chunk) => this.#take(chunk), error: fail });
    this.#encoder.configure(encoding(frames, options));
  }

  /** Takes the next samples, any number. They are dropped while too many wait. */
  write(samples) {
    if (this.#encoder.state !== "configured" || this.#written - this.#given > MOST_WAITING_S * RATE) return;
    const timestamp = Math.round((MICROSECONDS * this.#written) / RATE);
    const finite = samples.map((sample) => (Number.isFinite(sample) ? sample : 0));
    const data = new AudioData({
      format: "f32-planar", sampleRate: RATE, numberOfChannels: 1, numberOfFrames: samples.length, timestamp, data: finite,
    });
    this.#encoder.encode(data);
    data.close();
    this.#written += samples.length;
  }

  #take(chunk) {
    this.#given += this.#frames;
    const packet = new Uint8Array(chunk.byteLength);
    chunk.copyTo(packet);
    this.#deliver(packet);
  }

  close() {
    if (this.#encoder.state !== "closed") this.#encoder.close();
  }
}

/** Arrays of samples one after the other, without the first `dropped` samples. */
function joined(pieces, dropped) {
  const whole = new Float32Array(pieces.reduce((length, piece) => length + piece.length, 0));
  let at = 0;
  for (const piece of pieces) {
    whole.set(piece, at);
    at += piece.length;
  }
  return whole.slice(dropped);
}
