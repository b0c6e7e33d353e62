// Runs the Stream of server/web/nafir in Node for test_javascript_listeners.py: node javascript_listeners_driver.mjs MODULES
// Takes from its input, as JSON, messages of a server by name (binary ones as {hex}), and steps that the test wants to happen in turn. Prints
// as JSON what the stream sends and tells, step by step.

import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const { steps } = JSON.parse(readFileSync(0));
const sockets = [];
let log = [];
const limits = new Set(); // long timers, which end when a step says so
const startTimer = globalThis.setTimeout;
const stopTimer = globalThis.clearTimeout;
globalThis.setTimeout = (callback, ms) => {
  if (ms < 20_000) return startTimer(callback, ms);
  const limit = { callback };
  limits.add(limit);
  return limit;
};
globalThis.clearTimeout = (timer) => limits.delete(timer) || stopTimer(timer);

globalThis.WebSocket = class {
  static OPEN = 1;
  readyState = 0;
  #opened = [];

  constructor() {
    sockets.push(this);
  }

  addEventListener(_type, callback) {
    this.#opened.push(callback);
  }

  open() {
    this.readyState = 1;
    for (const callback of this.#opened) callback();
    this.onopen();
  }

  send(data) {
    log.push(typeof data === "string" ? { text: data } : { hex: Buffer.from(data).toString("hex") });
  }

  close() {
    this.readyState = 3;
  }
};

const { Stream } = await import(new URL("stream.js", `${pathToFileURL(process.argv[2])}/`));
const tell = (name, pick) => (detail, id) => log.push({ [name]: pick(detail, id) });
const stream = new Stream({
  url: "ws://there/v1/stream",
  hello: { scene: "flat", encoding: "f32" },
  listener: { position: [1, 1, 1], at: 0 },
  emitters: [],
  listeners: {
    block: tell("block", ({ number, sequence, channels }, id) => ({ number, sequence, id, first: channels[0][0] })),
    joined: tell("joined", (detail) => detail),
    left: tell("left", (detail) => detail),
    clock: tell("clock", ({ sampleClock }) => sampleClock),
    ended: tell("ended", (detail) => detail),
    refused: tell("refused", ({ code, listener }) => ({ code, listener })),
    posed: tell("posed", ({ poseId, listener }) => ({ poseId, listener })),
    state: ({ state, code, retryMs, isBusy }) => state === "waiting" && log.push({ state, code, retryMs, isBusy }),
    status: () => {},
    level: () => {},
    effects: () => {},
  },
});

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
const newest = () => sockets.at(-1);
const acts = {
  open: () => newest().open(),
  receive: (message) => newest().onmessage({ data: message.hex ? Uint8Array.from(Buffer.from(message.hex, "hex")).buffer : JSON.stringify(message) }),
  lose: (code) => newest().onclose({ code, reason: "" }),
  add: (listener) => stream.addListener(listener),
  move: (listener) => stream.moveListener(listener),
  remove: (id) => stream.removeListener(id),
  emitter: (emitter) => stream.setEmitter(emitter),
  feed: (id) => stream.feed(id, new Float32Array(128)),
  stop: (detail) => stream.stopEmitter(detail),
  removeEmitter: (id) => stream.removeEmitter(id),
  door: (door) => stream.setDoor(door),
  level: (level) => stream.setLevel(level),
  pause,
  expire() {
    for (const limit of limits) {
      limits.delete(limit);
      limit.callback();
    }
  },
  async reconnect() {
    const before = sockets.length;
    while (sockets.length === before) await pause(5);
  },
};
const logs = [];
for (const step of steps) {
  log = [];
  for (const [act, detail] of step) await acts[act](detail);
  logs.push(log);
}
stream.close();
console.log(JSON.stringify(logs));
