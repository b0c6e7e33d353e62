// Plays one sound at a time. Starting another fades the first out and the next in, so that nothing clicks.

const FADE_S = 0.012;

export class Player {
  #context = null;
  #playing = null; // {slot, source, gain, startedS, offsetS, loop, onEnd}

  /** Call in a user gesture: browsers allow sound only then. */
  async wake() {
    this.#context ??= new AudioContext({ latencyHint: "interactive" });
    if (this.#context.state !== "running") await this.#context.resume();
  }

  async decode(bytes) {
    this.#context ??= new AudioContext({ latencyHint: "interactive" });
    return this.#context.decodeAudioData(bytes);
  }

  /** The slot that is heard now; null if it is quiet. */
  get slot() {
    return this.#playing?.slot ?? null;
  }

  /** How many seconds of the sound, over all repetitions, have been heard since it was started. */
  get elapsedS() {
    return this.#playing ? this.#context.currentTime - this.#playing.startedS : 0;
  }

  /** Where in its sound the player is, in seconds. */
  get positionS() {
    if (!this.#playing) return 0;
    const { offsetS, source, loop } = this.#playing;
    const at = offsetS + this.elapsedS;
    return loop ? at % source.buffer.duration : Math.min(at, source.buffer.duration);
  }

  play(slot, buffer, { loop = false, offsetS = 0, onEnd = () => {} } = {}) {
    this.stop();
    const source = new AudioBufferSourceNode(this.#context, { buffer, loop });
    const gain = new GainNode(this.#context, { gain: 0 });
    source.connect(gain).connect(this.#context.destination);
    const now = this.#context.currentTime;
    gain.gain.setValueAtTime(0, now);
    gain.gain.linearRampToValueAtTime(1, now + FADE_S);
    const playing = { slot, source, gain, startedS: now, offsetS, loop, onEnd };
    source.onended = () => {
      if (this.#playing !== playing) return;
      this.#playing = null;
      onEnd();
    };
    source.start(now, offsetS);
    this.#playing = playing;
  }

  /** A sound that is stopped calls no `onEnd`. */
  stop() {
    if (!this.#playing) return;
    const { source, gain } = this.#playing;
    this.#playing = null;
    const now = this.#context.currentTime;
    gain.gain.cancelScheduledValues(now);
    gain.gain.setValueAtTime(gain.gain.value, now);
    gain.gain.linearRampToValueAtTime(0, now + FADE_S);
    source.stop(now + 2 * FADE_S);
  }
}
