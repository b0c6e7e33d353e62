// The worker of the stream. It passes commands from the page to a Stream, events back to the page, and audio blocks to the worklet of the
// listener who hears them.

import { buffersOf } from "./channels.js";
import { Stream } from "./stream.js";

let stream = null;
const ports = new Map(); // of the worklets: id of the listener, null for the first -> port
let order = null; // of the stream's ambisonics

/** Makes a worklet ready for a stream that counts its samples from zero. */
const restart = (id) => ports.get(id)?.postMessage({ restart: true, order });

function open({ url, key, hello, listener, emitters, port }) {
  stream?.close();
  ports.clear(); // other listeners went with their stream
  ports.set(null, port);
  const tell = (type) => (detail) => self.postMessage({ type, detail });
  stream = new Stream({
    url,
    key,
    hello,
    listener,
    emitters,
    listeners: {
      block: (block, id) => ports.get(id)?.postMessage(block, buffersOf(block.channels)),
      state(detail) {
        // A new stream counts its samples and poses from zero. One that goes on does not.
        if (detail.state === "live") order = detail.welcome.order ?? null;
        if (detail.state === "live" && !detail.welcome.resumed) restart(null);
        self.postMessage({ type: "state", detail });
      },
      posed: tell("posed"),
      status: tell("status"),
      level: tell("level"),
      effects: tell("effects"),
      refused: tell("refused"),
      clock: tell("clock"),
      ended(detail) {
        if (detail.removed) untap(detail.id);
        self.postMessage({ type: "ended", detail });
      },
      joined(detail) {
        restart(detail.id);
        self.postMessage({ type: "joined", detail });
      },
      left(detail) {
        ports.delete(detail.id);
        self.postMessage({ type: "left", detail });
      },
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

function untap(id) {
  taps.get(id)?.close();
  taps.delete(id);
}

const commands = {
  open,
  tap,
  listener: (detail) => stream?.setListener(detail),
  join({ port, ...detail }) {
    ports.set(detail.id, port);
    stream?.addListener(detail);
  },
  move: (detail) => stream?.moveListener(detail),
  leave({ id }) {
    stream?.removeListener(id);
    ports.delete(id);
  },
  emitter: (detail) => stream?.setEmitter(detail),
  stop: (detail) => stream?.stopEmitter(detail),
  remove({ id }) {
    stream?.removeEmitter(id);
    untap(id);
  },
  door: (detail) => stream?.setDoor(detail),
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
