// A stream that no server renders: what Stream is for a server's, with blocks that are computed here, from a field in a worker beside it. Direct
// sound does not wait for that worker: its path is found here. It does no I/O but messages to the worker, and reads its clock from outside, so
// that tests can drive it.

import { newChannels } from "../channels.js";
import { blockSizeAt } from "../wire.js";
import { DirectPaths } from "./direct_paths.js";
import { Convolver, DirectSound } from "./renderer.js";
import { ClipSource, LiveSource } from "./sources.js";

const CHANNELS = 4;
const MOST_EMITTERS = 8;
const BEHIND_S = 0.2; // of blocks that are late; more are left out
const STATUS_MS = 1000;
const REST_MS = 1000; // the pose of a listener at rest counts as new this often, so that the measured latency stays current
const SHORTEST_S = 0.1; // of the delay line
const MEASURED = 40; // responses
const MOST_LEAVING = 8; // emitters that ring out; of more, the first fade out in a block
const REHEARSED = 16; // blocks in a row that have to be in time before anything is heard: code that runs for the first time is slow
const PATIENCE_MS = 4000; // after which it is heard all the same
const LEAD_S = 0.13; // of blocks at the beginning that are there at once, so that a player can begin at once

const amplitudeOf = (gainDb = 0) => 10 ** (gainDb / 20);
const samePlace = (one, other) => one.every((at, axis) => at === other[axis]);

class LocalEmitter {
  #shape;
  #direct;
  #convolver;
  #input;
  #silence;
  #amplitude = null; // null before the first block
  wanted = {}; // what the page wants of it
  asked = -1; // newest pose for which the field was asked
  hasResponse = -1;
  ending = null; // blocks that are left to ring; null while it plays

  constructor(shape, source) {
    this.#shape = shape;
    this.source = source;
    const { block, samples, taps, longestS, sampleRate } = shape;
    [this.#input, this.#silence] = [new Float32Array(block), new Float32Array(block)];
    this.#direct = new DirectSound({ quantum: block, sampleRate, taps, longestS: Math.max(SHORTEST_S, longestS) });
    this.#convolver = new Convolver({ samples, quantum: block });
  }

  follow(path) {
    this.#direct.follow(path);
  }

  exchange(spectra) {
    return this.#convolver.exchange(spectra);
  }

  /** Whether a listener would wait for nothing but its sound. */
  get isPrepared() {
    return this.hasResponse >= 0 && this.source.isReady;
  }

  /** Whether it has been heard, so that it has something to ring out. */
  get hasSounded() {
    return this.#amplitude !== null;
  }

  /** Does the work of a block without its sound. Returns spectra that are no longer needed, or null. */
  rehearse(channels) {
    this.#direct.process(this.#silence, channels);
    return this.#convolver.process(this.#silence, channels);
  }

  end() {
    const { block, samples, longestS, sampleRate } = this.#shape;
    this.ending = Math.ceil((samples + longestS * sampleRate) / block) + 1;
  }

  /** Adds a block to the channels. Returns spectra that are no longer needed, or null. */
  process(channels) {
    const target = this.ending === null ? amplitudeOf(this.wanted.gainDb) : 0;
    const before = this.#amplitude ?? target;
    this.source.read(this.#input);
    const { length } = this.#input;
    for (let i = 0; i < length; i++) this.#input[i] *= before + ((i + 1) / length) * (target - before);
    this.#amplitude = target;
    this.#direct.process(this.#input, channels);
    return this.#convolver.process(this.#input, channels);
  }
}

export class LocalStream {
  #listeners;
  #tell;
  #now;
  #sampleRate;
  #block; // samples of a block
  #shape = null; // of responses, once the field is there
  #paths = null; // of direct sound, likewise
  #level = null; // its name, likewise
  #listener;
  #wanted = new Map(); // id -> what the page wants of an emitter
  #emitters = new Map(); // id -> LocalEmitter
  #leaving = new Set(); // those that ring out, the first to leave first
  #fading = []; // those that fade out with the next block
  #clips = new Map(); // name -> samples
  #poseId = 0;
  #posedAt = 0;
  #isHeard = false;
  #openedAt = 0;
  #startedAt = 0;
  #rendered = 0; // blocks, since startedAt
  #inTime = 0; // of those that were rehearsed last
  #unheard; // what a block of silence is rendered to, or one that fades out
  #sequence = 0;
  #late = 0;
  #dropped = 0;
  #toldAt = 0;
  #costs = [];

  /**
   * `hello` has scene, level and sampleRate, `server` and `key` are for the field. `tell(message, transfer)` sends to field_worker.js, whose
   * messages go to `receive`. `listeners` are those of Stream; `now` gives epoch milliseconds.
   */
  constructor({ server, key = null, hello, listener, emitters, listeners, tell, now }) {
    this.#listeners = listeners;
    this.#tell = tell;
    this.#now = now;
    this.#sampleRate = hello.sampleRate;
    this.#block = blockSizeAt(hello.sampleRate);
    this.#unheard = newChannels(CHANNELS, this.#block);
    this.#listener = listener;
    for (const emitter of emitters) this.#wanted.set(emitter.id, emitter);
    listeners.state({ state: "connecting", attempt: 0 });
    tell({ type: "open", server, key, scene: hello.scene, level: hello.level, sampleRate: hello.sampleRate, block: this.#block });
  }

  /** Takes a message of field_worker.js. */
  receive({ type, ...detail }) {
    const handlers = { opened: (shape) => this.#opened(shape), failed: (reason) => this.#failed(reason) };
    const emitter = this.#emitters.get(detail.id);
    if (handlers[type]) handlers[type](detail);
    else if (type === "response") this.#gotResponse(emitter, detail);
    else if (type === "refused") {
      if (emitter) emitter.hasResponse = emitter.asked; // its room stays what it was
      this.#outOfBounds(detail);
    }
  }

  #outOfBounds({ id, message }) {
    this.#listeners.refused({ code: "position_out_of_bounds", message, field: null, emitter: id });
  }

  #opened({ level, manifest, samples, ms }) {
    this.#costs.push(ms);
    const sampleRate = this.#sampleRate;
    this.#paths = new DirectPaths({ manifest, sampleRate });
    const { plan, speedOfSound, waves } = this.#paths;
    this.#shape = { samples, taps: waves.taps, longestS: plan.longestM / speedOfSound, sampleRate, block: this.#block };
    this.#level = level;
    this.#openedAt = this.#startedAt = this.#now();
    this.setListener({ ...this.#listener, at: this.#now() });
    for (const emitter of this.#wanted.values()) this.setEmitter(emitter);
  }

  /** Renders silence until blocks are in time, and every emitter has its sound and its first response. */
  #rehearse(now) {
    const due = this.#dueAt(now);
    if (due > this.#rendered) {
      this.#inTime = due - this.#rendered > 1 ? 0 : this.#inTime + 1;
      this.#rendered = due;
      for (const emitter of this.#emitters.values()) this.#giveBack(emitter.rehearse(this.#unheard));
    }
    const isPrepared = this.#inTime >= REHEARSED && [...this.#emitters.values()].every((emitter) => emitter.isPrepared);
    if (isPrepared || now - this.#openedAt > PATIENCE_MS) this.#begin();
  }

  #begin() {
    this.#isHeard = true;
    const welcome = {
      type: "welcome", session: "local", sample_rate: this.#sampleRate, block_size: this.#block, channels: CHANNELS, encoding: "f32",
      level: this.#level, order: 1, max_emitters: MOST_EMITTERS,
    };
    this.#listeners.state({ state: "live", welcome });
    this.setListener({ ...this.#listener, at: this.#now() });
    for (let lead = Math.ceil((LEAD_S * this.#sampleRate) / this.#block); lead > 0; lead--) this.#listeners.block(this.#render(false));
    this.#startedAt = this.#toldAt = this.#now();
    this.#rendered = 1; // the last of them is the one that is due now
  }

  #dueAt(now) {
    return Math.floor((((now - this.#startedAt) / 1000) * this.#sampleRate) / this.#block) + 1;
  }

  #failed({ code, message, needsKey }) {
    if (code !== null) this.#listeners.refused({ code, message, field: null });
    this.#listeners.state({ state: "refused", reason: message, needsKey });
  }

  #gotResponse(emitter, { poseId, spectra, ms }) {
    this.#costs.push(ms);
    if (this.#costs.length > MEASURED) this.#costs.shift();
    const unused = emitter ? emitter.exchange(spectra) : spectra;
    this.#giveBack(unused);
    if (emitter) emitter.hasResponse = Math.max(emitter.hasResponse, poseId); // a newer pose may have been refused meanwhile
  }

  #giveBack(spectra) {
    if (spectra) this.#tell({ type: "spare", spectra }, [spectra.buffer]);
  }

  #posed(at) {
    this.#posedAt = at;
    this.#listeners.posed({ poseId: this.#poseId, at });
  }

  setListener(listener) {
    const moved = !samePlace(this.#listener.position, listener.position);
    this.#listener = listener;
    if (!this.#shape) return;
    this.#posed(listener.at);
    for (const [id, emitter] of this.#emitters) {
      if (moved) this.#place(id, emitter);
    }
    this.#poseId += 1;
  }

  /** Moves the direct sound of an emitter, and asks for its response. Where a position is not inside the scene it stays as it was. */
  #place(id, emitter) {
    const poseId = this.#poseId;
    const [listener, place] = [[...this.#listener.position], [...emitter.wanted.position]];
    emitter.asked = poseId;
    try {
      emitter.follow(this.#paths.heard(listener, place));
    } catch (error) {
      emitter.hasResponse = poseId;
      this.#outOfBounds({ id, message: error.message });
      return;
    }
    this.#tell({ type: "place", id, poseId, listener, emitter: place });
  }

  setEmitter(wanted) {
    const { id, clip, loop, position } = wanted;
    this.#wanted.set(id, wanted);
    if (!this.#shape) return;
    let emitter = this.#emitters.get(id);
    if (emitter && emitter.wanted.clip !== clip) {
      this.#leave(id);
      emitter = undefined;
    }
    if (!emitter && this.#emitters.size >= MOST_EMITTERS) {
      const message = `at most ${MOST_EMITTERS} emitters are rendered here`;
      this.#listeners.refused({ code: "too_many_emitters", message, field: "id", emitter: id });
      return;
    }
    const moved = !emitter || !samePlace(emitter.wanted.position, position);
    if (!emitter) {
      const source = clip === undefined ? new LiveSource(this.#sampleRate) : new ClipSource(this.#clips.get(clip) ?? null, loop);
      emitter = new LocalEmitter(this.#shape, source);
      this.#emitters.set(id, emitter);
    }
    emitter.wanted = wanted;
    if (!moved) return;
    this.#posed(wanted.at);
    this.#place(id, emitter);
    this.#poseId += 1;
  }

  /** Takes the samples of a clip, at the rate of the stream. */
  setSound({ name, samples }) {
    this.#clips.set(name, samples);
    for (const { wanted, source } of this.#emitters.values()) if (wanted.clip === name) source.samples = samples;
  }

  /** Takes the next mono samples of a live emitter. */
  feed(id, samples) {
    if (this.#isHeard) this.#emitters.get(id)?.source.feed?.(samples);
  }

  removeEmitter(id) {
    this.#wanted.delete(id);
    if (this.#emitters.has(id)) this.#leave(id);
  }

  #leave(id) {
    const emitter = this.#emitters.get(id);
    this.#emitters.delete(id);
    this.#tell({ type: "remove", id });
    if (!emitter.hasSounded) return;
    emitter.end();
    this.#leaving.add(emitter);
    if (this.#leaving.size <= MOST_LEAVING) return;
    const [first] = this.#leaving;
    this.#leaving.delete(first);
    this.#fading.push(first);
  }

  /** Renders the blocks that are due. Call it often. */
  tick() {
    if (!this.#shape) return;
    const now = this.#now();
    if (now - this.#posedAt >= REST_MS) this.setListener({ ...this.#listener, at: now });
    if (!this.#isHeard) {
      this.#rehearse(now);
      return;
    }
    const due = this.#dueAt(now);
    const most = Math.ceil((BEHIND_S * this.#sampleRate) / this.#block);
    if (due - this.#rendered > most) {
      this.#dropped += due - this.#rendered - 1;
      this.#rendered = due - 1;
    }
    for (; this.#rendered < due; this.#rendered++) {
      const isLate = due - this.#rendered > 1;
      this.#late += isLate ? 1 : 0;
      this.#listeners.block(this.#render(isLate));
    }
    if (now - this.#toldAt >= STATUS_MS) {
      this.#toldAt = now;
      this.#listeners.status({ type: "status", blocks_late: this.#late, blocks_dropped: this.#dropped, ir_ms: { p50: this.#median } });
    }
  }

  get #median() {
    return this.#costs.length === 0 ? null : [...this.#costs].sort((a, b) => a - b)[this.#costs.length >> 1];
  }

  #render(late) {
    const channels = newChannels(CHANNELS, this.#block);
    const poses = { poseId: this.#newestPose, reverberationPoseId: this.#newestAnswered };
    for (const emitter of this.#emitters.values()) this.#giveBack(emitter.process(channels));
    for (const emitter of this.#leaving) {
      this.#giveBack(emitter.process(channels));
      emitter.ending -= 1;
      if (emitter.ending <= 0) this.#leaving.delete(emitter);
    }
    for (const emitter of this.#fading.splice(0)) {
      for (const channel of this.#unheard) channel.fill(0);
      this.#giveBack(emitter.process(this.#unheard));
      channels.forEach((samples, k) => samples.forEach((_, i) => (samples[i] += (1 - (i + 1) / this.#block) * this.#unheard[k][i])));
    }
    const sequence = this.#sequence++;
    return { ...poses, channels, sequence, sampleClock: sequence * this.#block, frames: this.#block, flags: 0, late };
  }

  get #newestPose() {
    return Math.max(0, this.#poseId - 1);
  }

  /** The newest pose with which every room's answer is heard. */
  get #newestAnswered() {
    let newest = this.#newestPose;
    for (const { hasResponse, asked } of this.#emitters.values()) if (hasResponse < asked) newest = Math.min(newest, Math.max(0, hasResponse));
    return newest;
  }
}
