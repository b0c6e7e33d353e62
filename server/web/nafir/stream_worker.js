// The worker of the stream. It passes commands from the page to a Stream, events back to the page, and audio blocks to the worklet.

import { Stream } from "./stream.js";

let stream = null;
let playerPort = null;

function open({ url, key, hello, listener, emitters, port }) {
  stream?.close();
  playerPort = port;
  const tell = (type) => (detail) => self.postMessage({ type, detail });
  stream = new Stream({
    url,
    key,
    hello,
    listener,
    emitters,
    listeners: {
      block: (block) => playerPort.postMessage(block, block.channels.map((samples) => samples.buffer)),
      state(detail) {
        // A new stream counts its samples and poses from zero. One that goes on does not.
        if (detail.state === "live" && !detail.welcome.resumed) playerPort.postMessage({ restart: true, order: detail.welcome.order ?? null });
        self.postMessage({ type: "state", detail });
      },
      posed: tell("posed"),
      status: tell("status"),
      level: tell("level"),
      effects: tell("effects"),
      refused: tell("refused"),
    },
  });
}

// The samples of a live emitter come through a port of their own, from the worklet that takes them.
const taps = new Map();

function tap({ id, port }) {
  taps.get(id)?.close();
  taps.set(id, port);
  port.onmessage = ({ data: samples }) => stream?.feed(id, samples);
}

const commands = {
  open,
  tap,
  listener: (detail) => stream?.setListener(detail),
  emitter: (detail) => stream?.setEmitter(detail),
  remove({ id }) {
    stream?.removeEmitter(id);
    taps.get(id)?.close();
    taps.delete(id);
  },
  level: ({ name }) => stream?.setLevel(name),
  renew: (changes) => stream?.renew(changes),
  effects: (wishes) => stream?.setEffects(wishes),
  close() {
    if (stream) stream.close();
    else self.postMessage({ type: "state", detail: { state: "closed" } });
    stream = null;
  },
};

self.onmessage = ({ data: { type, detail } }) => commands[type](detail);
