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
        // A new stream counts its samples and poses from zero.
        if (detail.state === "live") playerPort.postMessage({ restart: true, order: detail.welcome.order ?? null });
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

const commands = {
  open,
  listener: (detail) => stream?.setListener(detail),
  emitter: (detail) => stream?.setEmitter(detail),
  remove: ({ id }) => stream?.removeEmitter(id),
  level: ({ name }) => stream?.setLevel(name),
  renew: (changes) => stream?.renew(changes),
  effects: (wishes) => stream?.setEffects(wishes),
  close() {
    stream?.close();
    stream = null;
  },
};

self.onmessage = ({ data: { type, detail } }) => commands[type](detail);
