// Audio output: an AudioContext at the stream's sample rate, the worklet and a volume control.
// Events: "report", "heard" and "turned" from the worklet, and "interrupted" when the system stops the sound (a call, another tab).
// "heard" and "turned" have in addition `at`, the epoch millisecond when it leaves the sound card, and `outputS`, the time from the worklet
// until then.

export class Player extends EventTarget {
  #context = null;
  #node = null;
  #gain = null;
  #volume = 1;
  #captures = new Map();
  #nextCapture = 0;
  #ready = null;
  #started = false;
  #toSend = new Map(); // the newest message of each type for a worklet that is not there yet
  #wanted = false; // whether sound should be running, so that a pause followed by a start does nothing

  /** Starts audio. Browsers allow that only in a user gesture. Resolves with a port that takes audio blocks. */
  async start(sampleRate) {
    if (!this.#context) {
      this.#context = new AudioContext({ sampleRate, latencyHint: "interactive" });
      this.#ready = this.#build();
    }
    this.#wanted = true;
    const resumed = this.#context.resume();
    await this.#ready;
    await resumed;
    const { port1, port2 } = new MessageChannel();
    this.#node.port.postMessage({ type: "connect", port: port1 }, [port1]);
    this.#started = true;
    this.#fade(this.#volume);
    return port2;
  }

  async #build() {
    this.#context.onstatechange = () => {
      if (this.#wanted && this.#started && this.#context.state !== "running") this.dispatchEvent(new Event("interrupted"));
    };
    if (!this.#context.audioWorklet) throw new Error("This browser plays live audio only over https or from localhost.");
    await this.#context.audioWorklet.addModule(new URL("worklet.js", import.meta.url));
    this.#node = new AudioWorkletNode(this.#context, "nafir-player", { numberOfInputs: 0, outputChannelCount: [2] });
    this.#gain = new GainNode(this.#context, { gain: 0 });
    this.#node.connect(this.#gain).connect(this.#context.destination);
    this.#node.port.onmessage = ({ data }) => this.#receive(data);
    for (const message of this.#toSend.values()) this.#node.port.postMessage(message);
  }

  #receive(data) {
    if (data.type === "captured") {
      this.#captures.get(data.id)(data);
      this.#captures.delete(data.id);
      return;
    }
    this.dispatchEvent(new CustomEvent(data.type, { detail: data.type === "report" ? data : this.#timed(data) }));
  }

  #timed(heard) {
    const at = this.#audibleAt(heard.time);
    return { ...heard, at, outputS: Math.max(0, at - performance.timeOrigin - performance.now()) / 1000 };
  }

  /** Epoch milliseconds at which the sample of context time `time` reaches the output device. */
  #audibleAt(time) {
    const output = this.#context.getOutputTimestamp?.();
    if (output?.contextTime > 0 && output.performanceTime > 0) {
      return performance.timeOrigin + output.performanceTime + 1000 * (time - output.contextTime);
    }
    const latencyS = this.#context.outputLatency || this.#context.baseLatency;
    return performance.timeOrigin + performance.now() + 1000 * (time - this.#context.currentTime + latencyS);
  }

  /** Decodes ambisonic streams with these filters[ear][channel] of a head, which hears sound `delaySamples` later. */
  listenWith({ filters, delaySamples }) {
    this.#tell({ type: "head", filters, delaySamples });
  }

  /** Turns the head of ambisonic streams. `at` is the epoch millisecond of the turn. */
  turn(orientation, at) {
    this.#tell({ type: "turn", orientation, at, saidAt: Date.now() });
  }

  #tell(message) {
    if (this.#node) this.#node.port.postMessage(message);
    else this.#toSend.set(message.type, message);
  }

  #fade(target) {
    this.#gain.gain.setTargetAtTime(target, this.#context.currentTime, 0.015);
  }

  /** Fades out and lets the sound card sleep. */
  async pause() {
    if (!this.#gain) return;
    this.#wanted = this.#started = false;
    this.#fade(0);
    await new Promise((resolve) => setTimeout(resolve, 80));
    if (!this.#wanted) await this.#context.suspend();
  }

  set volume(value) {
    this.#volume = value;
    if (this.#gain && this.#context.state === "running") this.#fade(value);
  }

  /** The last `seconds` that were played, taken before the volume control: {sampleRate, left, right}. */
  capture(seconds) {
    if (!this.#node) return Promise.reject(new Error("nothing has been played yet"));
    const id = this.#nextCapture++;
    return new Promise((resolve) => {
      this.#captures.set(id, ({ left, right }) => resolve({ sampleRate: this.#context.sampleRate, left, right }));
      this.#node.port.postMessage({ type: "capture", id, seconds });
    });
  }
}
