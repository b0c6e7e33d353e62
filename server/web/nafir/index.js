// A scene of a Nafir server as part of a Web Audio graph.
//
//   const nafir = await connect(context, "https://sound.example", { scene: "apartment" });
//   nafir.output.connect(context.destination);
//   const radio = nafir.addEmitter({ clip: "woman-reading", position: [6, 3, 1.5] });
//   nafir.listener.position = [2.2, 2, 1.6];
//
// Positions are [x, y, z] in metres (x east, y north, z up), orientations quaternions [x, y, z, w] whose identity looks along +x.

import { LocalWorkerStream } from "./field/local_worker_stream.js";
import { apiOf, decoderUrl, fetchJson } from "./http.js";
import { PoseLedger } from "./latency.js";
import { decodesOpus } from "./opus.js";
import { Output } from "./output.js";
import { now } from "./stream.js";
import { orientationOf } from "./wire.js";
import { WorkerStream } from "./worker_stream.js";

export { RequestError } from "./http.js";
export { microphone } from "./microphone.js";
export { Output } from "./output.js";
export { WorkerStream } from "./worker_stream.js";

/** A stream that was refused. `code` is one of the server's error codes, or null. */
export class RefusedError extends Error {
  constructor(message, code = null) {
    super(message);
    this.name = "RefusedError";
    this.code = code;
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

  constructor(nafir, { id, input = null, gainDb = 0, ...pose }, moved) {
    super(pose, moved);
    this.#nafir = nafir;
    this.#gainDb = gainDb;
    this.id = id;
    /** The AudioNode that takes the sound of a live emitter; null if it plays a clip of the server. */
    this.input = input;
  }

  get gainDb() {
    return this.#gainDb;
  }

  set gainDb(gainDb) {
    this.#gainDb = gainDb;
    this.move({});
  }

  remove() {
    this.#nafir.removeEmitter(this.id);
  }
}

/**
 * A stream in an AudioContext. Events: "state" (detail: {state, ...}; connecting, live, waiting, refused or closed), "refused" (detail: an
 * error of the server, after which the stream goes on), "level", "effects", "status" (details: those messages).
 */
class Nafir extends EventTarget {
  #stream;
  #sound;
  #context;
  #api;
  #options;
  #emitters = new Map(); // id -> {emitter, source}
  #direct = new PoseLedger();
  #reverberation = new PoseLedger();
  #steady = false;
  #count = 0;

  constructor(context, api, options, sound, stream) {
    super();
    this.#context = context;
    this.#api = api;
    this.#options = options;
    this.#sound = sound;
    this.#stream = stream;
    /** The AudioNode to connect: what the listener hears, in two channels. */
    this.output = sound.node;
    /** The pose of the head: set its `position`, `orientation` or `yaw`. */
    this.listener = new Placed(options.listener, () => this.#listenerMoved());
    /** The last welcome of the server; null before the first. */
    this.welcome = null;
    this.state = "connecting";
    for (const type of ["refused", "level", "effects", "status"]) this.#pass(type);
    stream.addEventListener("posed", ({ detail }) => {
      this.#direct.posed(detail);
      this.#reverberation.posed(detail);
    });
    sound.addEventListener("report", ({ detail }) => (this.#steady = detail.playing));
    sound.addEventListener("heard", ({ detail }) => {
      this.#direct.heard(detail, this.#steady);
      this.#reverberation.heard({ ...detail, poseId: detail.reverberationPoseId }, this.#steady);
    });
  }

  #pass(type) {
    this.#stream.addEventListener(type, ({ detail }) => this.dispatchEvent(new CustomEvent(type, { detail })));
  }

  /** Resolves with the first welcome. Rejects with RefusedError, or with the reason of `signal`. */
  open(signal) {
    const { scene, level, effects, encoding, opus, bufferBlocks, order, head, key = null } = this.#options;
    const ambisonic = order === undefined ? {} : { output: "ambisonics", order };
    const hello = { scene, level, effects, encoding, opus, bufferBlocks, head: order === undefined ? head : undefined, ...ambisonic };
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
      if (order !== undefined) this.#listenWith(head).catch(end);
    });
  }

  /** Decodes an ambisonic stream with a head of the server. */
  async #listenWith(head) {
    const { key = null, order } = this.#options;
    const name = head ?? (await fetchJson(new URL("hrtfs", this.#api), { key })).default;
    const url = decoderUrl(this.#api, name, { order, sampleRate: this.#context.sampleRate });
    const { filters, delay_samples: delaySamples } = await fetchJson(url, { key });
    this.#sound.listenWith({ filters, delaySamples });
  }

  #listenerNow() {
    const { position, orientation } = this.listener;
    return { position, orientation, at: now() };
  }

  #listenerMoved() {
    const listener = this.#listenerNow();
    if (this.#options.order !== undefined) this.#sound.turn(listener.orientation, listener.at);
    this.#stream.tell("listener", listener);
  }

  /**
   * Adds an emitter that plays a `clip` of the server (one of GET /v1/clips, again and again unless `loop` is false) or, without one, the
   * sound of an AudioNode: give it as `source`, or connect it to the emitter's `input`.
   */
  addEmitter({ id = `emitter-${++this.#count}`, clip, source, loop, directivity, ...rest }) {
    if (this.#emitters.has(id)) throw new Error(`there is an emitter ${id} already`);
    const sound = clip === undefined ? { live: true } : { clip, loop };
    const tap = clip === undefined ? this.#tap(id) : null;
    const input = tap?.node ?? null;
    const emitter = new Emitter(this, { id, input, ...rest }, () => this.#emitterMoved(id));
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

  #emitterMoved(id) {
    const known = this.#emitters.get(id);
    if (!known) return; // removed
    const { position, orientation, gainDb } = known.emitter;
    this.#stream.tell("emitter", { id, ...known.sound, position, orientation, gainDb, at: now() });
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

  /** Chooses a quality level of the scene, or "auto". */
  set level(name) {
    this.#stream.tell("level", { name });
  }

  /** Switches effects on or off by name; null leaves one to the server's plan. */
  setEffects(effects) {
    this.#stream.tell("effects", { effects });
  }

  /** Medians of the last seconds, in milliseconds, from setting a pose to its sound: {direct, reverberation}, each {totalMs, worstMs,
      serverMs, bufferMs, outputMs} or null if nothing was measured yet. */
  get latency() {
    return { direct: this.#direct.summary(), reverberation: this.#reverberation.summary() };
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
    this.#stream.end();
    this.#sound.end();
    this.dispatchEvent(new CustomEvent("state", { detail: { state: "closed" } }));
  }
}

/**
 * Opens a stream of a server and makes an AudioNode of it. Resolves when the server has welcomed it; while the server cannot be reached or
 * has no room, it is tried again. Rejects with RefusedError if the server refuses it.
 *
 * `context` is an AudioContext of 44.1, 48 or 96 kHz, or of the scene's own rate. `url` is the server's address. Options: `scene`; `key`;
 * `listener` ({position, yaw or orientation}; without it, where a visit of the scene begins); `level`; `effects`; `head`; `order` (1 to 3:
 * the stream is ambisonic, and turns of the head are heard at once); `encoding` ("f32"; "s16", half as many bytes; or "opus", a tenth,
 * which is "s16" where server, browser or rate do not allow it: `welcome.encoding` says so); `opus` (its options); `bufferBlocks`;
 * `rendered` ("here": the field runs in this browser, in first-order ambisonics at the scene's own rate, and the server has nothing more to
 * do; only levels whose field knows directions can); `signal` (an AbortSignal that ends the attempt); `assets` (where this package's files are, for bundlers that move them).
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
