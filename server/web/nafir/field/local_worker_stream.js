// A LocalStream in a worker of its own, with the interface of WorkerStream: the scene is rendered in this browser. It fetches and decodes
// the clips that emitters play, since only a page can decode.

import { apiOf, fetchBytes } from "../http.js";
import { WorkerStream } from "../worker_stream.js";

const RETRY_MS = 5000; // after which a clip that could not be had is asked for again

export class LocalWorkerStream extends WorkerStream {
  #server = null;
  #key = null;
  #sampleRate = 0;
  #clips = new Map(); // those asked for: name -> when to ask again

  constructor(worker = new Worker(new URL("./stream_worker.js", import.meta.url), { type: "module" })) {
    super(worker);
  }

  /** Gives a command of stream_worker.js. The `url` of "open" is the address of a server, of which nothing is asked but files. */
  tell(type, detail, transfer = []) {
    if (type === "emitter") this.#fetch(detail);
    super.tell(type, type === "open" ? this.#opened(detail) : detail, transfer);
  }

  #opened({ url, ...stream }) {
    this.#server = apiOf(url);
    this.#key = stream.key ?? null;
    if (stream.hello.sampleRate !== this.#sampleRate) this.#clips.clear();
    this.#sampleRate = stream.hello.sampleRate;
    for (const emitter of stream.emitters) this.#fetch(emitter);
    return { ...stream, server: this.#server.href };
  }

  async #fetch({ clip }) {
    if (clip === undefined || this.#server === null || performance.now() < (this.#clips.get(clip) ?? 0)) return;
    this.#clips.set(clip, Infinity);
    const sampleRate = this.#sampleRate;
    try {
      const bytes = await fetchBytes(new URL(`clips/${encodeURIComponent(clip)}/audio`, this.#server), { key: this.#key });
      const decoded = await new OfflineAudioContext(1, 1, sampleRate).decodeAudioData(bytes.buffer);
      if (sampleRate === this.#sampleRate) super.tell("sound", { name: clip, samples: meanOf(decoded) });
    } catch (error) {
      this.#clips.set(clip, performance.now() + RETRY_MS);
      const detail = { code: error.code ?? "unplayable_clip", message: `${clip} cannot be played here: ${error.message}`, field: "clip" };
      this.dispatchEvent(new CustomEvent("refused", { detail }));
    }
  }
}

/** The mean of an AudioBuffer's channels. */
function meanOf(buffer) {
  const mean = new Float32Array(buffer.length);
  for (let channel = 0; channel < buffer.numberOfChannels; channel++) {
    const samples = buffer.getChannelData(channel);
    for (let i = 0; i < mean.length; i++) mean[i] += samples[i] / buffer.numberOfChannels;
  }
  return mean;
}
