// The worker of a scene that is rendered in the browser. It takes the commands of ../stream_worker.js, passes events back, and gives audio
// blocks to the worklet. The field computes in a worker of its own, so that a response never delays a block.

import { buffersOf } from "../channels.js";
import { LocalStream } from "./local_stream.js";

const TICK_MS = 4;
const now = () => performance.timeOrigin + performance.now();

let stream = null;
let field = null;
let ticking = 0;
const sounds = new Map(); // clips that were given before, at the rate of the newest stream
let soundsRate = 0;
const taps = new Map();

function open({ server, key, hello, listener, emitters, port }) {
  end();
  if (hello.sampleRate !== soundsRate) sounds.clear();
  soundsRate = hello.sampleRate;
  const tell = (type) => (detail) => self.postMessage({ type, detail });
  const worker = new Worker(new URL("./field_worker.js", import.meta.url), { type: "module" });
  field = worker;
  const own = new LocalStream({
    server,
    key,
    hello,
    listener,
    emitters,
    now,
    tell: (message, transfer = []) => worker.postMessage(message, transfer),
    listeners: {
      block: (block) => port.postMessage(block, buffersOf(block.channels)),
      state(detail) {
        if (detail.state === "live") port.postMessage({ restart: true, order: detail.welcome.order });
        self.postMessage({ type: "state", detail });
      },
      posed: tell("posed"),
      status: tell("status"),
      refused: tell("refused"),
    },
  });
  stream = own;
  for (const sound of sounds.values()) own.setSound(sound);
  worker.onmessage = ({ data }) => stream === own && own.receive(data);
  worker.onerror = () => stream === own && own.receive({ type: "failed", code: null, message: "The field could not be started." });
  ticking = setInterval(() => own.tick(), TICK_MS);
}

function end() {
  clearInterval(ticking);
  field?.terminate();
  stream = field = null;
}

function tap({ id, port }) {
  taps.get(id)?.close();
  taps.set(id, port);
  port.onmessage = ({ data: samples }) => stream?.feed(id, samples);
}

const commands = {
  open,
  tap,
  sound(detail) {
    sounds.set(detail.name, detail);
    stream?.setSound(detail);
  },
  listener: (detail) => stream?.setListener(detail),
  emitter: (detail) => stream?.setEmitter(detail),
  remove({ id }) {
    stream?.removeEmitter(id);
    taps.get(id)?.close();
    taps.delete(id);
  },
  close() {
    end();
    self.postMessage({ type: "state", detail: { state: "closed" } });
  },
};

// Levels and effects are a server's: here there is one level, with everything that it has.
self.onmessage = ({ data: { type, detail } }) => commands[type]?.(detail);
