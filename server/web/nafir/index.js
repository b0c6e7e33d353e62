// A scene of a Nafir server as part of a Web Audio graph.
//
//   const nafir = await connect(context, "https://sound.example", { scene: "apartment" });
//   nafir.output.connect(context.destination);
//   const radio = nafir.addEmitter({ clip: "woman-reading", position: [6, 3, 1.5] });
//   nafir.listener.position = [2.2, 2, 1.6];
//
// Positions are [x, y, z] in metres (x east, y north, z up), orientations quaternions [x, y, z, w] whose identity looks along +x.

import { LocalWorkerStream } from "./field/local_worker_stream.js";
import { apiOf, decoderUrl, deleteClip, fetchJson, uploadClip } from "./http.js";
import { PoseLedger } from "./latency.js";
import { decodesOpus } from "./opus.js";
import { Output } from "./output.js";
import { now } from "./stream.js";
import { orientationOf } from "./wire.js";
import { WorkerStream } from "./worker_stream.js";

export { RequestError, deleteClip, uploadClip } from "./http.js";
export { microphone } from "./microphone.js";
export { Output } from "./output.js";
export { WorkerStream } from "./worker_stream.js";

/** A stream that was refused, or a listener in it, whose id is `listener` then. `code` is one of the server's error codes, or null. */
export class RefusedError extends Error {
  constructor(message, code = null, listener = null) {
    super(message);
    this.name = "RefusedError";
    this.code = code;
    this.listener = listener;
  }
}

const LONGEST_ID = 64; // characters, as the server counts them

/** Throws RangeError for what no server takes as the id or the pose of a listener. */
function requireListener(id, { position, orientation, yaw = 0 }) {
  if (typeof id !== "string" || id === "" || [...id].length > LONGEST_ID || /\p{Surrogate}/u.test(id)) {
    throw new RangeError(`id: has to be 1 to ${LONGEST_ID} characters, not ${JSON.stringify(id)}`);
  }
  const areNumbers = (given, count) => given?.length === count && [...given].every(Number.isFinite);
  if (position !== undefined && !areNumbers(position, 3)) throw new RangeError(`position: has to be 3 numbers, not ${position}`);
  if (orientation !== undefined && !(areNumbers(orientation, 4) && orientation.some((each) => each !== 0))) {
    throw new RangeError(`orientation: has to be 4 numbers that are not all 0, not ${orientation}`);
  }
  if (!Number.isFinite(yaw)) throw new RangeError(`yaw: has to be a number, not ${yaw}`);
}

/** What one listener hears: its Output, how long poses take to be heard there, and how many blocks were. */
class Hearing {
  #direct = new PoseLedger();
  #reverberation = new PoseLedger();
  #steady = false;
  #counters = { blocks: 0, late: 0, gaps: 0, underruns: 0, stretches: 0 };

  constructor(sound) {
    this.sound = sound;
    sound.addEventListener("report", ({ detail }) => {
      this.#steady = detail.playing;
      this.#counters = detail.counters;
    });
    sound.addEventListener("heard", ({ detail }) => {
      this.#direct.heard(detail, this.#steady);
      this.#reverberation.heard({ ...detail, poseId: detail.reverberationPoseId }, this.#steady);
    });
  }

  posed(pose) {
    this.#direct.posed(pose);
    this.#reverberation.posed(pose);
  }

  get latency() {
    return { direct: this.#direct.summary(), reverberation: this.#reverberation.summary() };
  }

  get statistics() {
    const { blocks, late, gaps, underruns, stretches } = this.#counters;
    return { blocks, late, gaps, underruns, stretches };
  }
}

/** A place with a direction, whose changes are sent. */
class Placed {
  #position;
  #orientation;
  #moved;

  constructor({ position, ...direction }, moved) {
    this.#position = [...position];
    this.#orientation = orientationOf(direction);
    this.#moved = moved;
  }

  get position() {
    return [...this.#position];
  }

  set position(position) {
    this.move({ position });
  }

  get orientation() {
    return [...this.#orientation];
  }

  set orientation(orientation) {
    this.move({ orientation });
  }

  /** Turns a level head or emitter, counter-clockwise from +x, in radians. */
  set yaw(yaw) {
    this.move({ yaw });
  }

  /** Sets position and direction together. What is left out stays. */
  move({ position = this.#position, ...direction }) {
    if ("orientation" in direction || "yaw" in direction) this.#orientation = orientationOf(direction);
    this.#position = [...position];
    this.#moved();
  }
}

/** A source of sound in the scene. */
class Emitter extends Placed {
  #nafir;
  #gainDb;
  #changed;

  /** `changed({ rampS })` sends what it is now; by a ramp of its gain, if one is given. */
  constructor(nafir, { id, input = null, gainDb = 0, ...pose }, changed) {
    super(pose, changed);
    this.#nafir = nafir;
    this.#gainDb = gainDb;
    this.#changed = changed;
    this.id = id;
    /** The AudioNode that takes the sound of a live emitter; null if it plays a clip of the server. */
    this.input = input;
    /** Whether all sound of its clip has been heard. */
    this.hasEnded = false;
  }

  get gainDb() {
    return this.#gainDb;
  }

  set gainDb(gainDb) {
    this.setGain(gainDb);
  }

  /** Changes its gain by a ramp of so many seconds, linearly in decibels. */
  setGain(gainDb, { rampS } = {}) {
    this.#gainDb = gainDb;
    this.#changed({ rampS });
  }

  /** Lets its clip fade out within `fadeS` seconds, from the clock `at` of the stream on or at once. The event "ended" follows. */
  stop({ at, fadeS = 0.01 } = {}) {
    this.#nafir.stopEmitter(this.id, { at, fadeS });
  }

  remove() {
    this.#nafir.removeEmitter(this.id);
  }
}

/** A listener of a stream beside its first. */
class Listener extends Placed {
  #nafir;
  #hearing;

  constructor(nafir, id, hearing, pose, moved) {
    super(pose, moved);
    this.#nafir = nafir;
    this.#hearing = hearing;
    this.id = id;
    /** The AudioNode to connect: what this listener hears, in two channels. */
    this.output = hearing.sound.node;
  }

  /** As that of the stream, of this listener's poses. */
  get latency() {
    return this.#hearing.latency;
  }

  /** Counts since this listener was added, as those of the stream. */
  get statistics() {
    return this.#hearing.statistics;
  }

  /** The last `seconds` that it heard, at most twelve: {left, right}. */
  capture(seconds) {
    return this.#hearing.sound.capture(seconds);
  }

  remove() {
    this.#nafir.removeListener(this.id);
  }
}

/**
 * A stream in an AudioContext. Events: "state" (detail: {state, ...}; connecting, live, waiting, refused or closed), "refused" (detail: an
 * error of the server, after which the stream goes on), "level", "effects", "status" (details: those messages, with the id of a `listener`
 * beside the first), "ended" (detail: {id, removed} of an emitter all of whose clip has been heard, and that is removed if it was to be, or
 * if another server does not begin it again), "left" (detail: {id, code, message} of a listener whom a new connection may not have again).
 */
class Nafir extends EventTarget {
  #stream;
  #sound;
  #context;
  #api;
  #options;
  #emitters = new Map(); // id -> {emitter, source}
  #hearing;
  #clock = null; // {sampleClock, at}
  #others = new Map(); // id -> {listener, hearing, settle}: listeners beside the first. `settle` takes the end of their addListener
  #filters = new Map(); // of heads for ambisonics, by name: promises
  #count = 0;
  #listenerCount = 1;

  constructor(context, api, options, sound, stream) {
    super();
    this.#context = context;
    this.#api = api;
    this.#options = options;
    this.#sound = sound;
    this.#stream = stream;
    /** The AudioNode to connect: what the stream's first listener hears, in two channels. */
    this.output = sound.node;
    /** The pose of the stream's first listener: set its `position`, `orientation` or `yaw`. */
    this.listener = new Placed(options.listener, () => this.#listenerMoved());
    /** The last welcome of the server; null before the first. */
    this.welcome = null;
    this.state = "connecting";
    this.#hearing = new Hearing(sound);
    for (const type of ["refused", "level", "effects", "status"]) this.#pass(type);
    stream.addEventListener("posed", ({ detail }) => {
      const { listener, ...pose } = detail;
      if (listener === undefined) this.#hearing.posed(pose);
      else this.#others.get(listener)?.hearing.posed(pose);
    });
    stream.addEventListener("clock", ({ detail }) => (this.#clock = detail));
    stream.addEventListener("ended", ({ detail }) => {
      const known = this.#emitters.get(detail.id);
      if (!known) return; // removed meanwhile
      if (detail.removed) this.#emitters.delete(detail.id);
      if (known.emitter.hasEnded) return; // which has been said
      known.emitter.hasEnded = true;
      this.dispatchEvent(new CustomEvent("ended", { detail: { id: detail.id, removed: detail.removed } }));
    });
    stream.addEventListener("joined", ({ detail }) => {
      const other = this.#others.get(detail.id);
      if (!other) return; // removed meanwhile
      other.hearing.posed({ poseId: 0, at: now() }); // poses are numbered anew
      other.settle?.(null);
      other.settle = null;
    });
    stream.addEventListener("left", ({ detail }) => {
      const other = this.#others.get(detail.id);
      if (!other) return;
      this.#endListener(detail.id, new RefusedError(detail.message, detail.code, detail.id));
      if (!other.settle) this.dispatchEvent(new CustomEvent("left", { detail }));
    });
  }

  #pass(type) {
    this.#stream.addEventListener(type, ({ detail }) => this.dispatchEvent(new CustomEvent(type, { detail })));
  }

  /** Resolves with the first welcome. Rejects with RefusedError, or with the reason of `signal`. */
  open(signal) {
    const { scene, level, effects, encoding, opus, bufferBlocks, order, head, listeners, key = null } = this.#options;
    const ambisonic = order === undefined ? { head } : { output: "ambisonics", order };
    const hello = { scene, level, effects, encoding, opus, bufferBlocks, listeners, ...ambisonic };
    return new Promise((resolve, reject) => {
      let code = null;
      const end = (error) => {
        reject(error);
        this.close();
      };
      const given = () => end(signal.reason);
      if (signal?.aborted) {
        given();
        return;
      }
      signal?.addEventListener("abort", given);
      this.#stream.addEventListener("refused", ({ detail }) => (code = detail.code));
      this.#stream.addEventListener("failed", ({ detail }) => end(new Error(detail)));
      this.#stream.addEventListener("state", ({ detail }) => {
        if (this.state === "closed") return;
        this.state = detail.state;
        if (detail.state === "live") {
          this.welcome = detail.welcome;
          signal?.removeEventListener("abort", given);
          resolve(this);
        }
        if (detail.state === "refused") end(new RefusedError(detail.reason, code));
        this.dispatchEvent(new CustomEvent("state", { detail }));
      });
      const url = new URL("stream", this.#api);
      url.protocol = url.protocol.replace(/^http/, "ws");
      const port = this.#sound.connect();
      const started = { hello: { ...hello, sampleRate: this.#context.sampleRate }, listener: this.#listenerNow(), emitters: [] };
      this.#stream.open({ url: url.href, key, ...started, port });
      this.#listenerMoved();
      if (order !== undefined) this.#listenWith(this.#sound, head).catch(end);
    });
  }

  /** Decodes what an output gets of an ambisonic stream with a head of the server. */
  async #listenWith(sound, head) {
    const { key = null, order } = this.#options;
    const name = head ?? (await fetchJson(new URL("hrtfs", this.#api), { key })).default;
    const url = decoderUrl(this.#api, name, { order, sampleRate: this.#context.sampleRate });
    const { filters, delay_samples: delaySamples } = await fetchJson(url, { key });
    sound.listenWith({ filters, delaySamples });
  }

  #listenerNow() {
    return this.#turned(this.#sound, this.listener);
  }

  /** The pose that a listener has now, which its output is told where it has to know. */
  #turned(sound, { position, orientation }) {
    const at = now();
    if (this.#options.order !== undefined) sound.turn(orientation, at);
    return { position, orientation, at };
  }

  #listenerMoved() {
    this.#stream.tell("listener", this.#listenerNow());
  }

  /**
   * Adds a listener who hears the same emitters at the same time, and resolves once it is there: a Listener with an `output` of its own.
   * Options: `position` and `yaw` or `orientation` (without a position, where a visit of the scene begins), `head`, and an `id`. Rejects with
   * RefusedError if the server does not take it (too_many_listeners, server_busy, position_out_of_bounds, unknown_hrtf) or it is not there
   * within 30 s (its code is null then), and with RangeError for an id or numbers that no server takes; the stream goes on.
   */
  async addListener({ id = `listener-${++this.#listenerCount}`, head, ...pose } = {}) {
    const { order, rendered } = this.#options;
    if (rendered === "here") throw new RefusedError("a scene that is rendered here has one listener", "too_many_listeners", id);
    requireListener(id, pose);
    if (this.#others.has(id)) throw new RefusedError(`there is a listener ${id} already`, "duplicate_listener", id);
    if (this.state === "closed") throw new RefusedError("the stream is closed", null, id);
    const { position, yaw } = this.welcome.scene.listener;
    const sound = new Output(this.#context);
    const hearing = new Hearing(sound);
    const moved = () => this.#others.has(id) && this.#stream.tell("move", { id, ...this.#turned(sound, listener) });
    const listener = new Listener(this, id, hearing, pose.position ? pose : { position, yaw, ...pose }, moved);
    const entry = { listener, hearing, settle: null };
    this.#others.set(id, entry);
    const joined = new Promise((resolve, reject) => (entry.settle = (error) => (error ? reject(error) : resolve(listener))));
    const join = () => {
      if (this.#others.get(id) !== entry) return; // removed meanwhile
      const port = sound.connect();
      const start = { id, head: order === undefined ? head : undefined, ...this.#turned(sound, listener) };
      this.#stream.tell("join", { ...start, port }, [port]);
    };
    if (order === undefined) join();
    else this.#listenWith(sound, head).then(join, (error) => this.#others.get(id) === entry && this.#endListener(id, error));
    return joined;
  }

  removeListener(id) {
    if (!this.#others.has(id)) return;
    this.#stream.tell("leave", { id });
    this.#endListener(id, new RefusedError(`listener ${id} was removed`, null, id));
  }

  /** Ends the output of a listener beside the first, whose addListener fails with `error` if it still waits. */
  #endListener(id, error) {
    const { settle, hearing } = this.#others.get(id);
    this.#others.delete(id);
    settle?.(error);
    hearing.sound.end();
  }

  /** The listeners beside the first, by id. */
  get listeners() {
    return new Map([...this.#others].map(([id, { listener }]) => [id, listener]));
  }

  /** The clock that the stream has reached by now, in samples: about that of the frame after its newest block. It goes on over lost
      connections. 0 before the first block, and where the scene is rendered here. */
  get sampleClock() {
    if (this.#clock === null) return 0;
    const { sampleClock, at } = this.#clock;
    return sampleClock + Math.round(((now() - at) * this.welcome.sample_rate) / 1000);
  }

  /**
   * Adds an emitter that plays a `clip` of the server (one of GET /v1/clips, again and again unless `loop` is false) or, without one, the
   * sound of an AudioNode: give it as `source`, or connect it to the emitter's `input`.
   *
   * A clip begins at the clock `startAt` of the stream (`sampleClock`), to the sample, or at once, `offsetS` seconds into it; a loop goes from
   * `loopStartS` to `loopEndS`. It fades out at the clock `stopAt`. With `removeWhenEnded` its emitter is removed once all of its sound has
   * been heard. Live samples wait at the server for `jitterMs`, 2 to 250, by default for two blocks. Where the scene is rendered here, clips
   * are played from their start, and these options are ignored. What the server does not take ends in the event "refused".
   */
  addEmitter({ id = `emitter-${++this.#count}`, clip, source, loop, directivity, ...rest }) {
    if (this.#emitters.has(id)) throw new Error(`there is an emitter ${id} already`);
    const { jitterMs, startAt, stopAt, offsetS, loopStartS, loopEndS, removeWhenEnded } = rest;
    const played = { clip, loop, startAt, stopAt, offsetS, loopStartS, loopEndS, removeWhenEnded };
    const sound = clip === undefined ? { live: true, jitterMs } : played;
    const tap = clip === undefined ? this.#tap(id) : null;
    const input = tap?.node ?? null;
    const emitter = new Emitter(this, { id, input, ...rest }, (change) => this.#emitterMoved(id, change));
    this.#emitters.set(id, { emitter, tap, sound: { ...sound, directivity } });
    source?.connect(input);
    this.#emitterMoved(id);
    return emitter;
  }

  #tap(id) {
    const tap = this.#sound.tap();
    this.#stream.tell("tap", { id, port: tap.port }, [tap.port]);
    return tap;
  }

  #emitterMoved(id, { rampS } = {}) {
    const known = this.#emitters.get(id);
    if (!known) return; // removed
    const { position, orientation, gainDb } = known.emitter;
    this.#stream.tell("emitter", { id, ...known.sound, position, orientation, gainDb, rampS, at: now() });
  }

  /** As `stop` of an emitter. */
  stopEmitter(id, { at, fadeS = 0.01 } = {}) {
    const known = this.#emitters.get(id);
    if (!known || known.tap) return;
    known.sound.loop = false; // what was stopped is not begun again by a new stream
    this.#stream.tell("stop", { id, at, fadeS });
  }

  removeEmitter(id) {
    const known = this.#emitters.get(id);
    if (!known) return;
    this.#emitters.delete(id);
    known.tap?.end();
    this.#stream.tell("remove", { id });
  }

  /** All emitters, by id. */
  get emitters() {
    return new Map([...this.#emitters].map(([id, { emitter }]) => [id, emitter]));
  }

  /** Stores an audio file (a Blob) on the server. Resolves with the name by which an emitter plays it as its clip. Rejects with RequestError. */
  upload(file, { title } = {}) {
    return uploadClip(this.#api, file, { title, key: this.#options.key ?? null });
  }

  /** Deletes an uploaded clip. Emitters that play it go on. Rejects with RequestError. */
  deleteClip(name) {
    return deleteClip(this.#api, name, { key: this.#options.key ?? null });
  }

  /** Chooses a quality level of the scene, or "auto". */
  set level(name) {
    this.#stream.tell("level", { name });
  }

  /** Opens a door of the scene so far, from 0, shut, to 1. `welcome.doors` has those there are. */
  setDoor(name, openness) {
    this.#stream.tell("door", { name, openness });
  }

  /** Switches effects on or off by name; null leaves one to the server's plan. */
  setEffects(effects) {
    this.#stream.tell("effects", { effects });
  }

  /** Medians of the last seconds, in milliseconds, from setting a pose to its sound: {direct, reverberation}, each {totalMs, worstMs,
      serverMs, bufferMs, outputMs} or null if nothing was measured yet. */
  get latency() {
    return this.#hearing.latency;
  }

  /** Counts since the beginning, {blocks, late, gaps, underruns, stretches}: blocks that came; blocks that the server sent late; times that
      blocks were missing; times that there was nothing left to play; and times that the sound was stretched until the next block came. */
  get statistics() {
    return this.#hearing.statistics;
  }

  /** The last `seconds` that were heard, at most twelve: {left, right}. */
  capture(seconds) {
    return this.#sound.capture(seconds);
  }

  /** Ends the stream and what belongs to it. */
  close() {
    if (this.state === "closed") return;
    this.state = "closed";
    for (const { tap } of this.#emitters.values()) tap?.end();
    this.#emitters.clear();
    for (const id of [...this.#others.keys()]) this.#endListener(id, new RefusedError("the stream is closed", null, id));
    this.#stream.end();
    this.#sound.end();
    this.dispatchEvent(new CustomEvent("state", { detail: { state: "closed" } }));
  }
}

/**
 * Opens a stream of a server and makes an AudioNode of it. Resolves when the server has welcomed it; while the server cannot be reached or
 * has no room, it is tried again. Rejects with RefusedError if the server refuses it.
 *
 * The stream has the rate of `context`, an AudioContext of 44.1, 48 or 96 kHz, or of the scene's own rate. `url` is the server's address.
 * Options: `scene`; `key`; `listener` ({position, yaw or orientation}; without it, where a visit of the scene begins); `level`; `effects`;
 * `head`; `order` (1 to 3: the stream is ambisonic, and turns of the head are heard at once); `encoding` ("f32"; "s16", half as many bytes;
 * or "opus", a tenth, which is "s16" where server, browser or rate do not allow it: `welcome.encoding` says so); `opus` (its options);
 * `bufferBlocks`; `listeners` (how many there will be, the first included, so that the server keeps room for them); `rendered` ("here": the
 * field runs in this browser, in first-order ambisonics, and the server has nothing more to do; only levels whose field knows directions
 * can); `signal` (an AbortSignal that ends the attempt); `assets` (where this package's files are, for bundlers that move them).
 */
export async function connect(context, url, options) {
  const { key = null, signal, assets, listener, rendered = "server" } = options;
  const isHere = rendered === "here";
  const api = apiOf(url);
  const at = (name) => new URL(name, new URL(assets, globalThis.location?.href));
  const [sound, encoding, scene] = await Promise.all([
    Output.in(context, assets === undefined ? undefined : at("worklet.js")),
    options.encoding === "opus" ? opusOr("s16", context, api, { key, signal }) : options.encoding,
    listener === undefined ? fetchJson(new URL(`scenes/${encodeURIComponent(options.scene)}`, api), { key, signal }) : null,
  ]);
  const start = { position: [0, 0, 0], ...(scene?.listener ?? {}), ...listener };
  const file = isHere ? "field/stream_worker.js" : "stream_worker.js";
  const worker = assets === undefined ? undefined : new Worker(at(file), { type: "module" });
  const stream = isHere ? new LocalWorkerStream(worker) : new WorkerStream(worker);
  const opus = encoding === "opus" ? options.opus : undefined;
  const order = isHere ? 1 : options.order;
  const nafir = new Nafir(context, api, { ...options, order, encoding, opus, listener: start }, sound, stream);
  return nafir.open(signal);
}

/** "opus" where both the server and this browser have it at the context's rate, and otherwise another encoding. */
async function opusOr(other, { sampleRate }, api, options) {
  if (!(await decodesOpus(sampleRate))) return other;
  const { encodings } = await fetchJson(new URL("encodings", api), options).catch(() => ({ encodings: [] })); // of a server without any
  const found = encodings.find(({ name }) => name === "opus");
  return found && (found.sample_rates?.includes(sampleRate) ?? true) ? "opus" : other;
}
