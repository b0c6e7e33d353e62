import type { Orientation, Position } from "../index.js";

/** The channels W, Y, Z and X (ACN order, SN3D norm). Sample 0 is the moment of emission, and 1 is unit pressure at one metre. */
export type Channels = readonly [Float32Array, Float32Array, Float32Array, Float32Array];

/** The shortest path of sound. */
export interface DirectPath {
  lengthM: number;
  /** A unit vector from the listener towards the sound, in the axes of the world. */
  arrival: [number, number, number];
  /** What the edges of walls leave of it, in dB in octave bands from 125 Hz to 8 kHz. */
  gainDb: readonly number[];
}

export interface FieldOptions {
  /** One of the scene's quality levels whose field knows directions; without it, the first of them. */
  level?: string;
  /** Of responses; without it, the scene's own. */
  sampleRate?: number;
  /** An API key or token with the scope `render`, if the server asks for one. */
  key?: string | null;
  signal?: AbortSignal;
}

/** A trained field of a scene, computed here: after `load` no server is needed. A response takes milliseconds, so call it in a worker. */
export class Field {
  /** Fetches the manifest, one graph and the noises. Throws RequestError, Error for a scene that cannot be computed here, and RangeError for what is no sampleRate. */
  static load(server: string | URL, scene: string, options?: FieldOptions): Promise<Field>;
  /** Of what `load` fetches: scene.json, the ONNX file of the level's field, and the rows of the noises. */
  constructor(parts: { manifest: object; level?: string; sampleRate?: number; graph?: Uint8Array | null; noises?: readonly Float32Array[] | null });
  /** scene.json. */
  readonly manifest: object;
  readonly level: string;
  readonly sampleRate: number;
  /** Samples of a response. */
  readonly samples: number;
  readonly speedOfSound: number;
  /** The whole response, in the axes of a head with this orientation; without one, of the world. Throws RangeError for places outside the scene. */
  response(listener: Position, emitter: Position, orientation?: Orientation | null): Channels;
  /** The response without the direct sound, in the axes of the world. */
  reflections(listener: Position, emitter: Position, path?: DirectPath): Channels;
  directPath(listener: Position, emitter: Position): DirectPath;
  /** The minimum-phase filter of a direct path at `sampleRate`: edges, air and distance, without its delay. */
  directFilter(path: DirectPath): Float64Array;
  readonly start: { listener: Position; emitter: Position };
  /** Throws RangeError, with `name` in its message. */
  requireInside(position: Position, name: string): void;
}

/** The rows of a NumPy file of float32, as GET /v1/scenes/{scene}/ambisonic-noises answers. */
export function readRows(bytes: Uint8Array): Float32Array[];
