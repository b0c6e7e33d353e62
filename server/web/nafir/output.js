// What plays a stream in an AudioContext: an AudioWorkletNode that takes blocks through a port.
// Events: "report", "heard" and "turned" from the worklet. "heard" and "turned" have in addition `at`, the epoch millisecond when it leaves
// the sound card, and `outputS`, the time from the worklet until then.

const WORKLET = new URL("./worklet.js", import.meta.url);

export class Output extends EventTarget {
  #context;
  #captures = new Map();
  #nextCapture = 0;

  /** Loads the worklet into a context. */
  static async in(context, worklet = WORKLET) {
    if (!context.audioWorklet) throw new Error("This browser plays live audio only over https or from localhost.");
    await context.audioWorklet.addModule(worklet);
    return new Output(context);
  }

  /** Of a context that has the worklet. */
  constructor(context) {
    super();
    this.#context = context;
    /** The AudioNode: no inputs, two channels. */
    this.node = new AudioWorkletNode(context, "nafir-player", { numberOfInputs: 0, outputChannelCount: [2] });
    this.node.port.onmessage = ({ data }) => this.#receive(data);
  }

  /** A port that takes audio blocks, in place of any before. */
  connect() {
    const { port1, port2 } = new MessageChannel();
    this.take(port1);
    return port2;
  }

  /** Takes audio blocks from a port, those that wait there first, in place of any before. A stream that begins anew there is heard once
      enough of it has arrived, and what is there of the one before until then. */
  take(port) {
    this.node.port.postMessage({ type: "connect", port }, [port]);
  }

  /** What takes the sound of a live emitter: {node, port, end()}. `node` is the AudioNode to connect to, and its sound comes out of `port`,
      which is for the command "tap" of the stream. */
  tap() {
    const node = new AudioWorkletNode(this.#context, "nafir-tap", { numberOfOutputs: 1 });
    // A node is only asked to process where it leads somewhere. Its output is silent.
    node.connect(this.#context.destination);
    const { port1, port2 } = new MessageChannel();
    node.port.postMessage({ port: port1 }, [port1]);
    const end = () => {
      node.port.postMessage({ port: null });
      node.disconnect();
    };
    return { node, port: port2, end };
  }

  /** Ends the node: it plays nothing any more, and nothing keeps it. */
  end() {
    this.node.port.postMessage({ type: "end" });
    this.node.disconnect();
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
    this.node.port.postMessage({ type: "head", filters, delaySamples });
  }

  /** Turns the head of ambisonic streams. `at` is the epoch millisecond of the turn. */
  turn(orientation, at) {
    this.node.port.postMessage({ type: "turn", orientation, at, saidAt: Date.now() });
  }

  /** The last `seconds` that were played, at most twelve: {left, right}. */
  capture(seconds) {
    const id = this.#nextCapture++;
    return new Promise((resolve) => {
      this.#captures.set(id, ({ left, right }) => resolve({ left, right }));
      this.node.port.postMessage({ type: "capture", id, seconds });
    });
  }
}
