// A live stream that reconnects by itself. A server that has kept the stream goes on with it, and so does one that takes the newest snapshot
// of another; either is sent what it had not got yet. Else the stream begins anew with the wanted state (poses, emitters). It runs in a
// worker, so that drawing never delays audio. Times are epoch milliseconds.

import { authorized } from "./http.js";
import { OpusReader, OpusWriter, encodesOpus } from "./opus.js";
import {
  FLAG_LATE, FLAG_RESTART, PROTOCOL, isBlock, message, parseBlock, parsePackets, serializeDryBlock, serializeDryPacket, serializePose,
} from "./wire.js";

const POSE_INTERVAL_MS = 12; // at most about 80 poses a second; only the newest is sent
const ACKNOWLEDGE_EVERY = 4; // blocks
const RETRY_MS = [250, 500, 1000, 2000, 4000];
const REST_MS = 1000; // the pose of a listener at rest is sent again this often, so that the measured latency stays current
const SILENCE_MS = 4000; // a server that sends audio is never silent for this long
const REFUSED = 1008; // the hello was refused, so a new connection would not help
const ACCESS_ENDED = 4401; // the key or token has expired or was revoked
const TAKEN_OVER = 4409; // another connection has resumed the stream
const ENDED = 1000; // for good
const LOST = 4000; // a connection that is given up, whose stream is to be kept
const NO_EMITTER = "unknown_emitter";
const FORGOTTEN = "unknown_resume_token";
const DRAINING = "server_draining";
const NOT_KNOWN = "unknown_message"; // said by a server that is too old to have several listeners in a stream
const NOT_THERE = "unknown_listener"; // said of one that is removed, moved or acknowledged, not of one that is added
const ANSWER_MS = 30_000; // a listener that is not there for so long after it was asked for is given up
const MOST_ORDERS = 1024;
const CLOCK_EVERY = 16; // blocks
const NEEDS_KEY = 401;
const FORBIDDEN = 403;
const UPGRADE_REQUIRED = 426;
const BUSY = 503;
const OFTEN = 2; // a WebSocket may also fail for the moment
const UNSENT = "This server needs a key for the sound, too: this browser sends the one that it asked you for with pages alone.";

export const now = () => performance.timeOrigin + performance.now();

/** Subprotocols that carry a key, since a WebSocket of a browser has no headers of its own. */
function protocolsFor(key) {
  if (key === null) return [];
  const bytes = String.fromCharCode(...new TextEncoder().encode(key));
  const encoded = btoa(bytes).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
  return [`nafir.v${PROTOCOL}`, `nafir.key.${encoded}`];
}

export class Stream {
  #url;
  #key;
  #hello;
  #listeners;
  #socket = null;
  #welcomed = false;
  #attempt = 0;
  #retry = 0;
  #watchdog = 0;
  #heardAt = 0;
  #poseId = 0;
  #lastError = null;
  #unsent = 0; // how often in a row a WebSocket was refused for want of a key that the browser sends with requests
  #comeBackMs = null; // after which a server without room said to come back
  #goOnMs = null; // after which one that shuts down said to go on
  #missing = new Set(); // ids of emitters that were asked for and are not heard yet
  #refused = new Map(); // id of each of them that the server did not take when it was last asked -> whether it may be asked again
  #asking = 0; // timer that asks for them again
  #encoding = "f32";
  #opus = null; // the reader of the first listener's blocks in Opus
  #newOpus = () => null; // of the listener with this id, or of the first if it is null
  #packetFrames = null; // samples of a packet of live sound in Opus; null where it is sent as samples
  #writers = new Map(); // id of a live emitter -> its OpusWriter
  #token = null; // resumes the stream at the server that had it
  #resumeMs = 0; // for so long after the connection was lost
  #snapshot = null; // the newest; resumes the stream at any server that has the same secret
  #lostAt = null; // when the connection of a stream to be resumed was lost
  #last = {}; // {sequence, sampleClock} of the last block
  #clockOffset = 0; // what is added to the server's clock, which begins at 0 with each new stream
  #nextClock = 0; // of the frame after the first listener's newest block, and when that came
  #clockAt = 0;
  // The newest messages that the server counts: {text, key, emitter, adds, isSent, isOver}, and how many there were. `emitter` is the id of the
  // one that it is about, or null, and `adds` says whether it adds that one.
  #orders = [];
  #ordered = 0;
  #awaiting = new Map(); // key -> message that says what changed since the hello, for when the hello is answered
  #doors = null; // names of the scene's doors, once a welcome has said them
  #listener; // {position, at} and orientation or yaw
  #emitters = new Map(); // id -> {clip or live, position, gainDb, at} and what else add_emitter has
  #played = new Map(); // id -> {start, wasHeard, hasEnded} of emitters that the server has said are heard, from the clock start on, or over
  #dry = new Map(); // sequence of the next dry block of each live emitter that is heard
  #others = new Map(); // id -> listener beside the first: {position, orientation, head, at} and what `#entered` adds
  #dirty = new Set(); // "listener" and ids of emitters and other listeners that moved since they were last sent
  #sentAt = 0;
  #posedAt = new Map(); // id of a listener, null for the first -> when its pose was last sent
  #sending = 0;
  #heartbeat = 0;

  /**
   * `hello` is what message.hello takes, but for listener and emitters; `listeners` are callbacks: block(block, id), state({state, ...}),
   * posed({poseId, at, listener}), status(message), level(message), effects(message), refused({code, message, field, retry_after_s}),
   * clock({sampleClock, at}), ended({id, removed}), joined({id}) and left({id, code, message}). `ended` says that all sound of an emitter's
   * clip has been heard, or that no more will be, and whether the emitter is removed for that; then it may say so a second time. Clocks go
   * on over lost connections. `id` and `listener` are those of a listener beside the first: `joined` says that its blocks begin, in each new
   * stream, and `left` that it was refused, or was not there in time (its code is null then), and is not asked for again.
   */
  constructor({ url, key = null, hello, listener, emitters, listeners }) {
    this.#url = url;
    this.#key = key;
    this.#hello = hello;
    this.#listeners = listeners;
    this.#listener = listener;
    for (const emitter of emitters) this.#emitters.set(emitter.id, emitter);
    this.#connect();
  }

  setListener(listener) {
    this.#listener = listener;
    this.#dirty.add("listener");
    this.#schedule();
  }

  setEmitter(emitter) {
    const { id, clip, gainDb } = emitter;
    const known = this.#emitters.get(id);
    this.#emitters.set(id, emitter);
    if (!this.#isOpen) return;
    if (!known || known.clip !== clip) {
      if (known && !this.#refused.has(id)) this.#order(message.removeEmitter(id), { emitter: id });
      this.#played.delete(id);
      this.#dry.delete(id);
      this.#endWriter(id);
      this.#add(emitter);
    } else if (this.#refused.has(id)) {
      return; // it is asked for as it is then
    } else if (known.gainDb !== gainDb) {
      this.#order(message.setGain(emitter), { key: `gain ${id}`, emitter: id });
    } else {
      this.#dirty.add(`emitter ${id}`);
      this.#schedule();
    }
  }

  /** Lets the clip of an emitter fade out within `fadeS` seconds, from the clock `at` on or at once. One that the server has refused is not
      asked for again: it ends, removed. */
  stopEmitter({ id, at, fadeS }) {
    const emitter = this.#emitters.get(id);
    if (!emitter) return;
    if (this.#refused.has(id)) {
      this.#ended({ id, removed: true });
      return;
    }
    this.#emitters.set(id, { ...emitter, loop: false }); // what was stopped is not begun again by a new stream
    if (this.#isOpen) this.#order(message.stopEmitter({ id, stopAt: this.#serverClock(at), fadeS }), { emitter: id });
  }

  /** Adds a listener beside the first, who hears the same emitters: {id, position, orientation, head, at}. */
  addListener({ id, ...listener }) {
    const limit = setTimeout(() => this.#giveUp(id), ANSWER_MS);
    this.#others.set(id, { ...listener, number: null, opus: null, asked: null, hasBeen: false, limit });
    if (this.#isOpen) this.#askFor(id);
  }

  /** Moves a listener beside the first: {id, position, orientation, at}. */
  moveListener({ id, ...pose }) {
    const other = this.#others.get(id);
    if (!other) return;
    Object.assign(other, pose);
    this.#dirty.add(`listener ${id}`);
    this.#schedule();
  }

  removeListener(id) {
    if (!this.#drop(id) || !this.#isOpen) return;
    this.#order(message.removeListener(id));
  }

  #giveUp(id) {
    this.removeListener(id);
    this.#listeners.left({ id, code: null, message: `the listener was not there within ${ANSWER_MS / 1000} s` });
  }

  /** Sends the next mono samples of a live emitter, in Opus where the stream is and the browser can, else as samples: in single precision
      only where the stream has that. They are dropped while it is not heard yet. */
  feed(id, samples) {
    if (!this.#dry.has(id) || !this.#welcomed) return;
    if (this.#packetFrames !== null) this.#writerOf(id).write(samples);
    else this.#sendDry(id, (sequence) => serializeDryBlock({ id, sequence, samples, encoding: this.#encoding === "f32" ? "f32" : "s16" }));
  }

  #sendDry(id, serialized) {
    const sequence = this.#dry.get(id);
    if (sequence === undefined || !this.#welcomed) return;
    this.#dry.set(id, sequence + 1);
    this.#send(serialized(sequence));
  }

  #writerOf(id) {
    let writer = this.#writers.get(id);
    if (!writer) {
      const frames = this.#packetFrames;
      const deliver = (packet) => {
        if (this.#writers.get(id) === writer) this.#sendDry(id, (sequence) => serializeDryPacket({ id, sequence, frames, packet }));
      };
      // A browser that fails at it sends samples.
      writer = new OpusWriter({ frames, options: this.#hello.opus, deliver, fail: () => this.#endWriters() });
      this.#writers.set(id, writer);
    }
    return writer;
  }

  #endWriters() {
    this.#packetFrames = null;
    for (const id of this.#writers.keys()) this.#endWriter(id);
  }

  #endWriter(id) {
    this.#writers.get(id)?.close();
    this.#writers.delete(id);
  }

  /** Encodes live sound from now on, if this browser can. */
  async #encodeLive({ frame_samples: frames }, sampleRate) {
    const reader = this.#opus;
    const can = await encodesOpus(sampleRate, frames, this.#hello.opus);
    if (can && this.#opus === reader) this.#packetFrames = frames;
  }

  removeEmitter(id) {
    const isThere = !this.#refused.has(id);
    if (this.#dropEmitter(id) && this.#isOpen && isThere) this.#order(message.removeEmitter(id), { emitter: id });
  }

  /** Forgets an emitter. Returns whether it was known. */
  #dropEmitter(id) {
    this.#dry.delete(id);
    this.#endWriter(id);
    this.#dirty.delete(`emitter ${id}`);
    this.#missing.delete(id);
    this.#refused.delete(id);
    this.#played.delete(id);
    return this.#emitters.delete(id);
  }

  /** The clip of an emitter is over. The server does not have the emitter any more if it is `removed`. */
  #ended({ id, removed }) {
    if (!this.#emitters.has(id)) return;
    const isNews = removed || !this.#played.get(id)?.hasEnded;
    if (removed) {
      this.#dropEmitter(id);
      this.#endOrders(id); // so that it is not played again
    } else {
      this.#played.set(id, { ...this.#played.get(id), hasEnded: true });
    }
    if (isNews) this.#listeners.ended({ id, removed });
  }

  /** The newest order that adds an emitter, and those about it after that, are not sent again. */
  #endOrders(id) {
    const added = this.#orders.findLastIndex(({ emitter, adds }) => adds && emitter === id);
    if (added < 0) return;
    for (const order of this.#orders.slice(added)) if (order.emitter === id) order.isOver = true;
  }

  setLevel(level) {
    this.#hello = { ...this.#hello, level };
    this.#change(message.setLevel(level), "level");
  }

  /** Opens a door of the scene so far, from 0, shut, to 1. One that the scene does not have is an error of the server, and is not asked for
      again. */
  setDoor({ name, openness }) {
    if (this.#doors?.has(name) ?? true) this.#hello = { ...this.#hello, doors: { ...this.#hello.doors, [name]: openness } };
    this.#change(message.setDoor({ name, openness }), `door ${name}`);
  }

  /** Each of `effects` is on, off, or null to follow the plan; `output` is null to keep the present one. */
  setEffects({ effects, output }) {
    const wished = { ...this.#hello.effects, ...effects };
    for (const [name, isOn] of Object.entries(wished)) if (isOn === null) delete wished[name];
    this.#hello = { ...this.#hello, effects: wished, output: output ?? this.#hello.output };
    this.#change(message.setEffects({ effects, output }));
  }

  /** Begins a new stream, since only a hello says what `changes` say: the head, or the channels of the output. */
  renew(changes) {
    this.#hello = { ...this.#hello, ...changes };
    this.#beginAnew();
  }

  #beginAnew() {
    clearTimeout(this.#retry);
    this.#detach(ENDED);
    this.#forget();
    this.#attempt = 0;
    this.#connect();
  }

  close() {
    clearTimeout(this.#retry);
    clearTimeout(this.#sending);
    for (const { limit } of this.#others.values()) clearTimeout(limit);
    this.#detach(ENDED);
    this.#forget();
    this.#listeners.state({ state: "closed" });
  }

  #add(emitter) {
    const { startAt, stopAt } = emitter;
    this.#missing.add(emitter.id);
    this.#refused.delete(emitter.id);
    const clocks = { startAt: this.#serverClock(startAt), stopAt: this.#serverClock(stopAt) };
    this.#order(message.addEmitter({ ...emitter, ...clocks }), { emitter: emitter.id, adds: true });
  }

  #serverClock(clock) {
    return clock === undefined ? undefined : Math.max(0, Math.round(clock) - this.#clockOffset);
  }

  #askAgain() {
    this.#addRefused();
    for (const [id, { asked }] of this.#others) if (asked === null) this.#askFor(id);
  }

  #addRefused() {
    for (const [id, mayBeAsked] of this.#refused) if (mayBeAsked) this.#add(this.#emitters.get(id));
  }

  #askFor(id) {
    const other = this.#others.get(id);
    other.asked = message.addListener({ id, ...other });
    this.#order(other.asked);
  }

  /** Forgets a listener beside the first. Returns whether it was known. */
  #drop(id) {
    const other = this.#others.get(id);
    other?.opus?.close();
    clearTimeout(other?.limit);
    this.#dirty.delete(`listener ${id}`);
    this.#posedAt.delete(id);
    return this.#others.delete(id);
  }

  /** The server has a listener beside the first, under this number. */
  #entered(id, number) {
    const other = this.#others.get(id);
    if (!other) return; // removed meanwhile
    other.opus?.close();
    clearTimeout(other.limit);
    Object.assign(other, { number, hasBeen: true, opus: this.#newOpus(id) });
    this.#dirty.add(`listener ${id}`); // where it is by now
    this.#schedule();
  }

  /** Takes an error about a listener beside the first. One who comes back with a new connection is asked for again, where the server says
      when; any other one is not. */
  #refusedListener({ listener: id, code, message: said, retry_after_s: retryS }) {
    const other = this.#others.get(id);
    if (!other || other.number !== null || code === NOT_THERE) return;
    other.asked = null;
    if (other.hasBeen && retryS) return;
    this.#drop(id);
    this.#listeners.left({ id, code, message: said });
  }

  /** Takes an error that may be about a listener whom an old server does not know how to add. Had it been about something else, the server
      would have that listener. */
  #refusedUnnamed(error) {
    const [id] = [...this.#others].find(([, { number, asked }]) => number === null && asked !== null) ?? [];
    if (id === undefined) return;
    this.#refusedListener({ ...error, listener: id });
    this.#order(message.removeListener(id));
  }

  /** Whether there is a stream that messages are for: one with a connection, or one to be resumed. */
  get #isOpen() {
    return this.#welcomed || this.#canResume;
  }

  get #canResume() {
    return this.#token !== null || this.#snapshot !== null;
  }

  /** Keeps a snapshot in place of the last one. What it covers need not be sent again. */
  #keep({ snapshot, handled }) {
    this.#snapshot = snapshot;
    while (this.#orders.length > 0 && this.#ordered - this.#orders.length < handled) this.#orders.shift();
  }

  /** Sends a message that changes what the hello says too. While a hello is not answered yet, the message waits. */
  #change(text, key = null) {
    if (this.#isOpen) this.#order(text, { key });
    else this.#awaiting.set(key ?? text, text);
  }

  /** Sends a message that changes the stream, now or when it is resumed. One that waits for that gives way to a newer one with its key.
      `emitter` is the id of the one that it is about, and that it `adds` or changes. */
  #order(text, { key = null, emitter = null, adds = false } = {}) {
    const older = key === null ? -1 : this.#orders.findIndex((order) => order.key === key && !order.isSent);
    if (older >= 0) {
      this.#orders.splice(older, 1);
      this.#ordered -= 1;
    }
    this.#orders.push({ text, key, emitter, adds, isSent: this.#welcomed, isOver: false });
    this.#ordered += 1;
    if (this.#orders.length > MOST_ORDERS) this.#orders.shift();
    if (this.#welcomed) this.#send(text);
  }

  /** Begins anew with the next connection. */
  #forget() {
    this.#token = this.#snapshot = this.#lostAt = null;
    this.#last = {};
    this.#orders = [];
    this.#ordered = 0;
    this.#missing.clear();
    this.#refused.clear();
    this.#dry.clear();
    for (const other of this.#others.values()) other.number = other.asked = null;
  }

  /** A connection was lost: notes which emitters were heard in the last block or before it. */
  #noteHeard() {
    for (const played of this.#played.values()) played.wasHeard ||= played.start < this.#nextClock;
  }

  /** Whether a server that does not have an emitter is not to begin it again: its clip has ended, or plays once and was heard. */
  #isOver(id) {
    const { wasHeard = false, hasEnded = false } = this.#played.get(id) ?? {};
    const { live, loop = true } = this.#emitters.get(id);
    return hasEnded || (wasHeard && !live && !loop);
  }

  /** What is over is not begun again by a new stream. */
  #endPlayed() {
    this.#noteHeard();
    for (const id of [...this.#emitters.keys()]) if (this.#isOver(id)) this.#ended({ id, removed: true });
    this.#played.clear();
  }

  /** Leaves the connection with a close code. */
  #detach(code) {
    clearTimeout(this.#asking);
    this.#opus?.close();
    this.#opus = null;
    for (const other of this.#others.values()) other.opus?.close();
    this.#endWriters();
    clearInterval(this.#watchdog);
    clearInterval(this.#heartbeat);
    const socket = this.#socket;
    this.#socket = null;
    this.#welcomed = false;
    if (!socket) return;
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close(code);
  }

  #connect() {
    this.#listeners.state({ state: "connecting", attempt: this.#attempt });
    const socket = new WebSocket(this.#url, protocolsFor(this.#key));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      if (this.#token !== null && now() - this.#lostAt > this.#resumeMs) this.#token = null;
      if (this.#canResume) {
        socket.send(message.resume({ token: this.#token, snapshot: this.#snapshot, ...this.#last }));
        return;
      }
      this.#forget();
      this.#endPlayed();
      this.#awaiting.clear(); // the hello says it
      const { at, ...listener } = this.#listener;
      const listeners = Math.max(this.#hello.listeners ?? 0, this.#others.size && 1 + this.#others.size) || undefined;
      socket.send(message.hello({ ...this.#hello, listener, emitters: this.#emitters.size, listeners }));
      this.#poseId = 0; // the hello's listener is pose 0
      this.#listeners.posed({ poseId: 0, at: Math.max(at, now()) });
    };
    socket.onmessage = ({ data }) => (typeof data === "string" ? this.#receive(JSON.parse(data)) : this.#receiveBlock(data));
    let isOpen = false;
    socket.addEventListener("open", () => {
      isOpen = true;
      this.#unsent = 0;
    });
    socket.onclose = ({ code, reason }) => (isOpen ? this.#lost(code, reason) : this.#unopened(socket, code, reason));
    this.#socket = socket;
    this.#heardAt = now();
    this.#watchdog = setInterval(() => {
      if (now() - this.#heardAt < SILENCE_MS) return;
      this.#lost(0, "");
    }, 1000);
  }

  #ask(options = {}) {
    return fetch(this.#url.replace(/^ws/, "http"), authorized({ cache: "no-store", ...options }, this.#key)).catch(() => null);
  }

  // A browser does not tell why a WebSocket was refused. Asked by HTTP, the server says so, and when to come back if it has no room. A key
  // that its user gave the browser itself (HTTP Basic) comes with what is asked by HTTP; not every browser sends it with a WebSocket.
  async #unopened(socket, code, reason) {
    const answer = await this.#ask();
    const problem = [NEEDS_KEY, FORBIDDEN].includes(answer?.status) ? await answer.json().catch(() => ({})) : {};
    const needsAnother = answer?.status === NEEDS_KEY || problem.code === "scope_missing";
    const isUnsent = answer?.status === UPGRADE_REQUIRED && this.#key === null && (await this.#ask({ credentials: "omit" }))?.status === NEEDS_KEY;
    if (this.#socket !== socket) return; // closed or renewed meanwhile
    this.#unsent = isUnsent ? this.#unsent + 1 : 0;
    if (needsAnother || this.#unsent >= OFTEN) {
      this.#unsent = 0;
      this.#detach(ENDED);
      this.#listeners.state({ state: "refused", reason: needsAnother ? problem.detail : UNSENT, needsKey: true });
      return;
    }
    if (answer?.status === BUSY) this.#comeBackMs = 1000 * Number(answer.headers.get("Retry-After")) || null;
    this.#lost(code, reason);
  }

  #lost(code, reason) {
    const wasHeard = this.#welcomed;
    this.#detach(LOST);
    if (wasHeard) this.#lostAt = now();
    if (code === REFUSED && this.#lastError === FORGOTTEN) {
      this.#forget();
      this.#lastError = null;
      this.#connect();
      return;
    }
    if ([REFUSED, ACCESS_ENDED, TAKEN_OVER].includes(code)) {
      this.#forget();
      const told = this.#lastError ?? (reason || "The server refused the stream.");
      this.#listeners.state({ state: "refused", reason: told, needsKey: code === ACCESS_ENDED });
      return;
    }
    const wait = this.#comeBackMs ?? this.#goOnMs ?? RETRY_MS[Math.min(this.#attempt, RETRY_MS.length - 1)];
    const isBusy = this.#comeBackMs !== null;
    this.#comeBackMs = this.#goOnMs = null;
    this.#attempt += 1;
    this.#listeners.state({ state: "waiting", code, reason, retryMs: wait, isBusy });
    this.#retry = setTimeout(() => this.#connect(), wait);
  }

  #receive(received) {
    this.#heardAt = now();
    if (received.type === "welcome") this.#welcome(received);
    else if (received.type === "status") this.#listeners.status(received);
    else if (received.type === "level_changed") this.#listeners.level(received);
    else if (received.type === "plan_changed") this.#listeners.effects(received);
    else if (received.type === "emitter_added") this.#added(received.id, received.sample_clock);
    else if (received.type === "emitter_ended") this.#ended(received);
    else if (received.type === "listener_added") this.#joined(received.id, received.index);
    else if (received.type === "snapshot") this.#keep(received);
    else if (received.type === "error") {
      this.#lastError = received.code === FORGOTTEN ? FORGOTTEN : received.message;
      if (received.code === FORGOTTEN) return; // the stream begins anew
      const comeBackMs = received.retry_after_s ? 1000 * received.retry_after_s : null;
      if (received.code === DRAINING) {
        this.#goOnMs = comeBackMs;
        return; // the end of the connection says so
      }
      if (!this.#welcomed) {
        this.#comeBackMs = comeBackMs;
        if (comeBackMs !== null) return; // the state says so
      } else if (comeBackMs !== null) {
        clearTimeout(this.#asking);
        this.#asking = setTimeout(() => this.#askAgain(), comeBackMs);
      }
      const { emitter } = received;
      // What is said about one that the server does not have is no answer to the question for it.
      if (this.#missing.has(emitter) && received.code !== NO_EMITTER) this.#refused.set(emitter, comeBackMs !== null);
      if (received.listener) this.#refusedListener(received);
      else if (received.code === NOT_KNOWN) this.#refusedUnnamed(received);
      this.#listeners.refused(received);
    }
  }

  #joined(id, number) {
    if (this.#others.has(id)) this.#listeners.joined({ id });
    this.#entered(id, number);
  }

  #added(id, clock) {
    this.#missing.delete(id);
    const wasRefused = this.#refused.delete(id);
    if (!this.#emitters.has(id)) return;
    if (this.#isOver(id)) {
      // The server goes by a snapshot from before it was heard, and begins it again.
      this.#ended({ id, removed: true });
      this.#order(message.removeEmitter(id), { emitter: id });
      return;
    }
    this.#played.set(id, { start: clock + this.#clockOffset, wasHeard: false, hasEnded: false });
    if (this.#emitters.get(id).live) this.#dry.set(id, 0);
    if (wasRefused) this.#tell(id); // an error was about something else, and nothing has been said since
  }

  /** Says how loud an emitter is by now, and where. */
  #tell(id) {
    this.#order(message.setGain(this.#emitters.get(id)), { key: `gain ${id}`, emitter: id });
    this.#dirty.add(`emitter ${id}`);
    this.#schedule();
  }

  #welcome(welcome) {
    if (welcome.resumed && welcome.resumed.handled < this.#ordered - this.#orders.length) {
      this.#beginAnew(); // some of what was said is gone, and only a hello says it all
      return;
    }
    this.#welcomed = true;
    if (!welcome.resumed && this.#nextClock > 0) this.#clockOffset = this.#continued(welcome);
    this.#encoding = welcome.encoding;
    // A browser that fails at Opus gets samples.
    const fail = () => this.renew({ encoding: "s16", opus: undefined });
    this.#newOpus = (id) => (welcome.opus ? new OpusReader(welcome.opus, (block) => this.#listeners.block(block, id), fail) : null);
    this.#opus = this.#newOpus(null);
    if (welcome.opus) this.#encodeLive(welcome.opus, welcome.sample_rate);
    this.#attempt = 0;
    this.#lastError = null;
    this.#dirty.clear();
    this.#token = welcome.resume_token ?? null;
    this.#resumeMs = 1000 * (welcome.resume_s ?? 0);
    this.#lostAt = null;
    this.#doors = new Set(Object.keys(welcome.doors ?? {}));
    this.#listeners.state({ state: "live", welcome });
    if (welcome.resumed) {
      this.#goOn(welcome.resumed);
    } else {
      for (const id of this.#others.keys()) this.#askFor(id); // before what they are to hear from its beginning
      for (const emitter of this.#emitters.values()) this.#add(emitter);
      for (const [key, text] of this.#awaiting) this.#order(text, { key });
      this.#awaiting.clear();
    }
    // Everything that moved between hello and welcome is in here.
    this.setListener({ ...this.#listener, at: now() });
    clearInterval(this.#heartbeat);
    this.#heartbeat = setInterval(() => {
      const rests = (id) => now() - this.#posedAt.get(id) > REST_MS / 2;
      for (const id of this.#others.keys()) if (rests(id)) this.moveListener({ id, at: now() });
      if (rests(null)) this.setListener({ ...this.#listener, at: now() });
    }, REST_MS);
  }

  /** The clock at which a new stream of the server's begins: as much later as there was none. A block comes so many blocks before its time. */
  #continued({ sample_rate: rate, block_size: blockSize, buffer_blocks: buffered }) {
    const away = ((now() - this.#clockAt) * rate) / 1000 - buffered * blockSize;
    return this.#nextClock + blockSize * Math.max(0, Math.ceil(away / blockSize));
  }

  /** Sends what the server had not got when the connection was lost, and where everything is now. What plays once and was heard since a
      snapshot is not begun again. */
  #goOn({ handled, listeners = [] }) {
    const missed = Math.max(0, this.#ordered - handled);
    this.#noteHeard();
    for (const { emitter, adds } of this.#orders.slice(this.#orders.length - missed)) {
      if (adds && this.#emitters.has(emitter) && this.#isOver(emitter)) this.#ended({ id: emitter, removed: true });
    }
    const unhandled = this.#orders.splice(this.#orders.length - missed, missed);
    const lost = unhandled.filter(({ isOver }) => !isOver);
    this.#orders.push(...lost);
    this.#ordered -= unhandled.length - lost.length;
    for (const order of lost) {
      this.#send(order.text);
      order.isSent = true;
      if (!order.adds || !this.#emitters.has(order.emitter)) continue;
      this.#missing.add(order.emitter); // though it may have been heard since the snapshot
      this.#refused.delete(order.emitter);
      this.#played.delete(order.emitter);
      this.#dry.delete(order.emitter);
    }
    this.#addRefused();
    for (const id of this.#emitters.keys()) this.#dirty.add(`emitter ${id}`);
    const numbers = new Map(listeners.map(({ id, index }) => [id, index]));
    for (const [id, other] of this.#others) {
      if (lost.some(({ text }) => text === other.asked)) {
        other.number = null; // the server is yet to have it
      } else if (!numbers.has(id)) {
        const wasThere = other.number !== null;
        other.number = null;
        if (!wasThere) this.#askFor(id); // else an error says why it is gone
      } else if (other.number === null) {
        this.#joined(id, numbers.get(id)); // which was said just before the connection was lost
      } else {
        this.#entered(id, numbers.get(id));
      }
    }
  }

  #receiveBlock(buffer) {
    this.#heardAt = now();
    if (!isBlock(buffer)) return; // a newer server may send other kinds
    const { header: block, packets } = this.#opus ? parsePackets(buffer) : { header: parseBlock(buffer, this.#encoding), packets: null };
    const { sequence = 0, sampleClock = 0 } = this.#last;
    this.#last = { sequence: Math.max(sequence, block.sequence), sampleClock: Math.max(sampleClock, block.sampleClock) }; // of all listeners
    if (block.number === 0) this.#noteClock(block);
    const [id, opus] = block.number === 0 ? [null, this.#opus] : this.#numbered(block.number);
    if (id === undefined) return; // of a listener that was removed meanwhile
    if (block.sequence % ACKNOWLEDGE_EVERY === ACKNOWLEDGE_EVERY - 1) this.#send(message.acknowledge(block.sequence, id ?? undefined));
    const told = { ...block, late: (block.flags & FLAG_LATE) !== 0 };
    if (packets) opus.read(told, packets, (block.flags & FLAG_RESTART) !== 0);
    else this.#listeners.block(told, id);
  }

  #noteClock({ sequence, sampleClock, frames }) {
    this.#nextClock = sampleClock + frames + this.#clockOffset;
    this.#clockAt = now();
    if (sequence % CLOCK_EVERY === 0) this.#listeners.clock({ sampleClock: this.#nextClock, at: this.#clockAt });
  }

  /** The id and the reader of the listener beside the first with this number; nothing if there is none. */
  #numbered(number) {
    for (const [id, other] of this.#others) if (other.number === number) return [id, other.opus];
    return [];
  }

  #schedule() {
    if (!this.#welcomed || this.#sending) return;
    const wait = Math.max(0, this.#sentAt + POSE_INTERVAL_MS - now());
    this.#sending = setTimeout(() => {
      this.#sending = 0;
      this.#sendPoses();
    }, wait);
  }

  #sendPoses() {
    if (!this.#welcomed) return;
    this.#sentAt = now();
    for (const { id, position, orientation, at } of this.#emitters.values()) {
      if (!this.#dirty.has(`emitter ${id}`) || this.#refused.has(id)) continue;
      this.#send(message.moveEmitter({ id, position, orientation, poseId: ++this.#poseId }));
      this.#listeners.posed({ poseId: this.#poseId, at });
    }
    for (const [id, { number, at, ...pose }] of this.#others) {
      if (number === null || !this.#dirty.has(`listener ${id}`)) continue;
      this.#send(serializePose({ poseId: ++this.#poseId, number, ...pose }));
      this.#listeners.posed({ poseId: this.#poseId, at, listener: id });
      this.#posedAt.set(id, this.#sentAt);
    }
    if (this.#dirty.has("listener")) {
      const { at, ...pose } = this.#listener;
      this.#send(serializePose({ poseId: ++this.#poseId, ...pose }));
      this.#listeners.posed({ poseId: this.#poseId, at });
      this.#posedAt.set(null, this.#sentAt);
    }
    this.#dirty.clear();
  }

  #send(data) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(data);
  }
}
