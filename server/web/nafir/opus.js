// Blocks in Opus, decoded by WebCodecs. The browser decodes when it likes, so blocks come out a little later than they go in, in order.

const RATE = 48_000; // at which browsers decode Opus, whatever it was made from
const MICROSECONDS = 1e6;

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
      const channels = this.#streams.flatMap((count, stream) => Array.from({ length: count }, (_, plane) => planesOf(stream, plane)));
      if (channels.length === 1) channels.push(channels[0].slice()); // a single channel is heard by both ears
      this.#deliver({ ...block, channels });
    }
  }

  close() {
    this.#queue = [];
    for (const decoder of this.#decoders) decoder.close();
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
