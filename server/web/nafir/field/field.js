// A trained field of a scene, in this browser: from the bundle of a server, it computes impulse responses as first-order ambisonics (ACN
// order, SN3D norm), the samples of the server's own `impulse-response?output=ambisonics`. At another `sampleRate` than the scene's they are
// those that the server convolves in streams of this rate.
//
//   const field = await Field.load("https://sound.example", "apartment");
//   const [w, y, z, x] = field.response([2.2, 2, 1.6], [6.2, 3.2, 1.5]);
//
// A response takes some milliseconds: call it in a worker (field_worker.js), and never in an AudioWorklet. Positions are [x, y, z] in metres,
// orientations quaternions [x, y, z, w].

import { rotation } from "../ambisonics.js";
import { apiOf, fetchBytes, fetchJson } from "../http.js";
import { BandNoises } from "./band_noises.js";
import { DirectPaths } from "./direct_paths.js";
import { OCTAVE_BANDS_HZ } from "./floor_plan.js";
import { Gate } from "./gate.js";
import { Network } from "./network.js";
import { Resampler } from "./resampler.js";

const EAR_AHEAD_S = 0.00026; // sound reaches the nearer ear at most this much before the middle of the head
const LEAST_POWER = 1e-10;
const ORDER = 1;
const CHANNELS = (ORDER + 1) ** 2;
const AIR_IMPEDANCE = 1.204 * 343;
const FIELD_INCIDENCE_DB = 5.5;

/** [band] dB that a wall of so many kg/m2 takes from sound that goes through it (server/acoustics/transmission.py). */
const wallLossDb = (mass) =>
  OCTAVE_BANDS_HZ.map((hz) => Math.max(0, 10 * Math.log10(1 + ((Math.PI * hz * mass) / AIR_IMPEDANCE) ** 2) - FIELD_INCIDENCE_DB));

const mirrorDb = ({ absorption, scattering }) =>
  absorption.map((absorbed, band) => 10 * Math.log10(Math.max(LEAST_POWER, (1 - absorbed) * (1 - scattering[band]))));

/** The level of this name, or the first whose field knows directions. Throws Error if there is none. */
function levelOf({ id, levels, fields, direct_sound: directSound }, name) {
  const knows = ({ field }) => fields[field]?.predicts === "directions" || (field === "none" && directSound !== "field");
  const found = name === undefined ? levels.find(knows) : levels.find((level) => level.name === name);
  if (!found) throw new Error(name === undefined ? `scene ${id} has no field that knows directions` : `scene ${id} has no level ${name}`);
  if (!knows(found)) throw new Error(`level ${found.name} of scene ${id} does not know from where sound arrives`);
  return found;
}

/** The rows of a NumPy file of float32. */
export function readRows(bytes) {
  const header = new DataView(bytes.buffer, bytes.byteOffset);
  const start = 10 + header.getUint16(8, true);
  const [, rows, columns] = /'shape': \((\d+), (\d+)\)/.exec(new TextDecoder().decode(bytes.subarray(10, start))) ?? [];
  if (bytes.length !== start + 4 * rows * columns) throw new Error("the noises are damaged");
  const samples = new Float32Array(bytes.slice(start).buffer);
  return Array.from({ length: Number(rows) }, (_, row) => samples.subarray(row * columns, (row + 1) * columns));
}

export class Field {
  #direct;
  #network = null;
  #parameters;
  #reverberation = null;
  #gate = null;
  #mirrorsDb = null;
  #wallLossDb = null;
  #knownHarmonics = 0;
  #ownRate; // of what the network's output is decoded to
  #ownSamples;
  #resampler = null; // from that to the rate of responses; null if it is the same

  /**
   * Fetches what a field needs from a server, with the address of it or of its v1/: the manifest, one graph, and the noises. Throws
   * RequestError where the server refuses, Error for a scene that cannot be computed here, and RangeError for what is no `sampleRate`.
   */
  static async load(server, scene, { level, sampleRate, key = null, signal } = {}) {
    const at = new URL(`scenes/${encodeURIComponent(scene)}/`, apiOf(server));
    const manifest = await fetchJson(new URL("bundle/scene.json", at), { key, signal });
    const { name, field } = levelOf(manifest, level);
    if (field === "none") return new Field({ manifest, level, sampleRate });
    const noisesUrl = new URL(`ambisonic-noises?order=${ORDER}&level=${encodeURIComponent(name)}`, at);
    const [graph, noises] = await Promise.all([
      fetchBytes(new URL(`bundle/${encodeURIComponent(manifest.fields[field].file)}`, at), { key, signal }),
      fetchBytes(noisesUrl, { key, signal }),
    ]);
    return new Field({ manifest, level, sampleRate, graph, noises: readRows(noises) });
  }

  /**
   * `manifest` is scene.json, `graph` (Uint8Array) the ONNX file of the level's field, `noises` the rows of GET ambisonic-noises. Responses have
   * the `sampleRate`, by default the scene's own.
   */
  constructor({ manifest, level: name, sampleRate = manifest.codec.sample_rate, graph = null, noises = null }) {
    if (!Number.isInteger(sampleRate) || sampleRate < 1) throw new RangeError(`sampleRate: has to be a whole number of Hz, not ${sampleRate}`);
    const level = levelOf(manifest, name);
    const file = manifest.fields[level.field];
    const { image_order: imageOrder = 0 } = manifest;
    /** scene.json. */
    this.manifest = manifest;
    this.level = level.name;
    this.#direct = new DirectPaths({ manifest, sampleRate });
    this.#parameters = file?.codec ?? manifest.codec;
    this.speedOfSound = this.#direct.speedOfSound;
    this.sampleRate = sampleRate;
    [this.#ownRate, this.#ownSamples] = [manifest.codec.sample_rate, manifest.codec.samples];
    if (sampleRate !== this.#ownRate) this.#resampler = new Resampler({ from: this.#ownRate, to: sampleRate, samples: this.#ownSamples });
    /** Samples of a response. */
    this.samples = this.#resampler?.samples ?? this.#ownSamples;
    if (imageOrder > 0) {
      const { walls, floor, ceiling } = manifest.geometry.materials;
      this.#mirrorsDb = { walls: mirrorDb(walls), floor: mirrorDb(floor), ceiling: mirrorDb(ceiling) };
      const mass = walls.surface_mass_kg_m2 ?? null;
      if (manifest.transmission && mass !== null) this.#wallLossDb = wallLossDb(mass);
    }
    if (!file) return;
    if (this.#parameters.sample_rate !== this.#ownRate) throw new Error(`level ${level.name} has a sample rate of its own`);
    this.#network = new Network(graph);
    const known = level.order === null || level.order === undefined ? file.order : Math.min(level.order, file.order);
    this.#knownHarmonics = (known + 1) ** 2 - 1;
    this.#reverberation = new BandNoises(this.#parameters, noises.slice(0, CHANNELS), level.frames ?? null);
    this.#gate = new Gate(this.#parameters, { hasFirstReflections: imageOrder > 0 });
  }

  /** Throws RangeError for a position that is not inside the scene. */
  requireInside(position, name) {
    this.#direct.requireInside(position, name);
  }

  /** Where a visit of the scene begins: {listener, emitter}, two positions. */
  get start() {
    const { bounds: { minimum, maximum }, start } = this.manifest;
    const middle = minimum.map((low, axis) => (low + maximum[axis]) / 2);
    return { listener: start?.listener ?? middle, emitter: start?.emitter ?? middle };
  }

  /** The direct sound: {lengthM, arrival, gainDb}, the length of its path, the direction from the listener, and gains of edges per band. */
  directPath(listener, emitter) {
    return this.#direct.between(listener, emitter);
  }

  /** The whole response, [W, Y, Z, X] in the axes of a head with this orientation (default: the world's). Throws RangeError as `requireInside`. */
  response(listener, emitter, orientation = null) {
    const path = this.directPath(listener, emitter);
    const channels = this.reflections(listener, emitter, path);
    this.#direct.waves.add(path, channels);
    if (orientation) turn(channels, rotation(orientation, ORDER));
    return channels;
  }

  /** The response without the direct sound, in world axes: what a room answers. */
  reflections(listener, emitter, path = this.directPath(listener, emitter)) {
    this.requireInside(listener, "listener");
    this.requireInside(emitter, "emitter");
    const channels = this.#network ? this.#late(listener, emitter, path) : Array.from({ length: CHANNELS }, () => new Float32Array(this.samples));
    if (this.#mirrorsDb) {
      for (const { lengthM, arrival, surface } of this.#direct.plan.reflections(listener, emitter)) {
        this.#direct.waves.add({ lengthM, arrival, gainDb: this.#mirrorsDb[surface] }, channels);
      }
    }
    if (this.#wallLossDb) this.#addThroughWalls(listener, emitter, channels);
    return channels;
  }

  /** The filter of the direct sound: minimum phase, with its gain by distance. */
  directFilter(path) {
    return this.#direct.waves.filter(path);
  }

  #late(listener, emitter, path) {
    const row = (values) => ({ dims: [1, values.length], data: Float32Array.from(values) });
    const { log_magnitude: levels, directions } = this.#network.run({ listener: row(listener), emitter: row(emitter), path: row(path.described) });
    const { columns } = this.#reverberation;
    if (levels.data.length !== OCTAVE_BANDS_HZ.length * columns) throw new Error("the graph does not fit the manifest");
    const lead = this.#parameters.lead_samples;
    const aligned = (path.lengthM / this.speedOfSound) * this.#ownRate - lead;
    if (!Number.isFinite(aligned)) throw new RangeError("no way leads from emitter to listener");
    const harmonics = directions?.data.subarray(0, this.#knownHarmonics * levels.data.length) ?? new Float32Array(0);
    const channels = this.#reverberation.decode({ logMagnitude: levels.data, directions: harmonics }, aligned, this.#ownSamples);
    const echoS = this.#direct.plan.firstEchoM(listener, emitter) / this.speedOfSound;
    this.#gate.open(channels, Math.floor(aligned) + lead, Math.floor((echoS - EAR_AHEAD_S) * this.#ownRate));
    return this.#resampler?.resample(channels) ?? channels;
  }

  #addThroughWalls(listener, emitter, channels) {
    const walls = this.#direct.plan.wallsBetween(listener, emitter);
    if (walls === 0) return;
    const offset = emitter.map((at, axis) => at - listener[axis]);
    const lengthM = Math.hypot(...offset);
    const arrival = offset.map((along) => along / lengthM);
    this.#direct.waves.add({ lengthM, arrival, gainDb: this.#wallLossDb.map((loss) => -walls * loss) }, channels);
  }
}

/** Turns channels by the matrix of a rotation, in place. */
function turn([, ...others], matrix) {
  const [y, z, x] = others.map((channel) => channel.slice());
  others.forEach((channel, i) => {
    const row = CHANNELS * (i + 1);
    for (let n = 0; n < channel.length; n++) channel[n] = matrix[row + 1] * y[n] + matrix[row + 2] * z[n] + matrix[row + 3] * x[n];
  });
}
