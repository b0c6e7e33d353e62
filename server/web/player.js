// Audio output of the page: an AudioContext, whose sample rate is that of streams, the output of the stream and a volume control.
// Events: those of the output, and "interrupted" when the system stops the sound (a call, another tab).

import { Output } from "./nafir/output.js";

const OUTPUT_EVENTS = ["report", "heard", "turned"];
const USUAL_HZ = 48_000; // has all that is audible

/** The rate at which a scene ({sample_rate, sample_rates}) is played through a sound card: the card's own if streams have it, else another. */
export function rateFor(cardHz, { sample_rate: ownHz, sample_rates: offeredHz = [ownHz] }) {
  if (offeredHz.includes(cardHz) && cardHz <= USUAL_HZ) return cardHz;
  return offeredHz.includes(USUAL_HZ) ? USUAL_HZ : ownHz;
}

/** An AudioContext of the rate that `choose` gives for that of the sound card. */
function openContext(choose) {
  const latencyHint = "interactive";
  const context = new AudioContext({ latencyHint });
  const sampleRate = choose(context.sampleRate);
  if (sampleRate === context.sampleRate) return context;
  context.close();
  return new AudioContext({ latencyHint, sampleRate });
}

export class Player extends EventTarget {
  #context = null;
  #output = null;
  #gain = null;
  #volume = 1;
  #ready = null;
  #started = false;
  #head = null; // what an output that is not there yet will listen with
  #turn = null; // and how it will be turned
  #wanted = false; // whether sound should be running, so that a pause followed by a start does nothing

  /** Starts audio, the first time at the rate that `choose` gives for that of the sound card. Browsers allow that only in a user gesture.
      Resolves with a port that takes audio blocks. */
  async start(choose) {
    if (!this.#context) {
      this.#context = openContext(choose);
      this.#ready = this.#build();
    }
    this.#wanted = true;
    const resumed = this.#context.resume();
    await this.#ready;
    await resumed;
    const port = this.#output.connect();
    this.#started = true;
    this.#fade(this.#volume);
    return port;
  }

  /** Plays what comes from a port from now on; see Output. */
  take(port) {
    this.#output.take(port);
  }

  async #build() {
    this.#context.onstatechange = () => {
      if (this.#wanted && this.#started && this.#context.state !== "running") this.dispatchEvent(new Event("interrupted"));
    };
    const output = await Output.in(this.#context);
    this.#gain = new GainNode(this.#context, { gain: 0 });
    output.node.connect(this.#gain).connect(this.#context.destination);
    for (const type of OUTPUT_EVENTS) output.addEventListener(type, ({ detail }) => this.dispatchEvent(new CustomEvent(type, { detail })));
    if (this.#head) output.listenWith(this.#head);
    if (this.#turn) output.turn(...this.#turn);
    this.#output = output;
  }

  /** Decodes ambisonic streams with these filters[ear][channel] of a head, which hears sound `delaySamples` later. */
  listenWith(head) {
    this.#head = head;
    this.#output?.listenWith(head);
  }

  /** Turns the head of ambisonic streams. `at` is the epoch millisecond of the turn. */
  turn(orientation, at) {
    this.#turn = [orientation, at];
    this.#output?.turn(orientation, at);
  }

  /** The AudioContext; null before the first start. */
  get context() {
    return this.#context;
  }

  /** Of the AudioContext, in Hz; null before the first start. */
  get sampleRate() {
    return this.#context?.sampleRate ?? null;
  }

  /** What takes the sound of a live emitter; see Output. */
  tap() {
    return this.#output.tap();
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
  async capture(seconds) {
    if (!this.#output) throw new Error("nothing has been played yet");
    return { sampleRate: this.#context.sampleRate, ...(await this.#output.capture(seconds)) };
  }
}
