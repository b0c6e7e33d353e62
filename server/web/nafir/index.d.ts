/** [x, y, z] in metres: x east, y north, z up. */
export type Position = readonly [number, number, number];
/** A quaternion [x, y, z, w] whose identity looks along +x. */
export type Orientation = readonly [number, number, number, number];

export interface Direction {
  orientation?: Orientation;
  /** Of a level head or emitter: radians counter-clockwise from +x. */
  yaw?: number;
}

export interface Pose extends Direction {
  position: Position;
}

export type State = "connecting" | "live" | "waiting" | "refused" | "closed";

export interface StateDetail {
  state: State;
  attempt?: number;
  /** Of "live". */
  welcome?: Welcome;
  /** Of "waiting" and "refused". */
  reason?: string;
  /** Of "waiting": milliseconds until the next attempt. */
  retryMs?: number;
  /** Of "waiting": whether the server has no room. */
  isBusy?: boolean;
  /** Of "refused": whether another key may help. */
  needsKey?: boolean;
}

/** The server's answer to a hello; docs/reference/stream.md has all of it. */
export interface Welcome {
  type: "welcome";
  session: string;
  scene: { id: string; name: string; bounds: { minimum: Position; maximum: Position }; [more: string]: unknown };
  sample_rate: number;
  block_size: number;
  channels: number;
  encoding: "f32" | "s16" | "opus";
  level: string;
  order?: number;
  max_emitters: number | null;
  /** How far each door of the scene is open, from 0, shut, to 1. Scenes without doors do not have it. */
  doors?: Record<string, number>;
  [more: string]: unknown;
}

/** An error of the server, after which the stream goes on. */
export interface Refusal {
  code: string;
  message: string;
  field: string | null;
  emitter?: string | null;
  /** The id of a listener beside the first. */
  listener?: string | null;
  retry_after_s?: number;
}

export interface Latency {
  totalMs: number;
  worstMs: number;
  serverMs: number;
  bufferMs: number;
  outputMs: number;
}

export interface Statistics {
  blocks: number;
  /** Blocks that the server sent late. */
  late: number;
  /** Times that blocks were missing. */
  gaps: number;
  /** Times that there was nothing left to play. */
  underruns: number;
  /** Times that the sound was stretched until the next block came. */
  stretches: number;
}

export interface Directivity {
  pattern: "omnidirectional" | "subcardioid" | "cardioid" | "supercardioid" | "hypercardioid" | "figure_of_eight" | "measured";
  order?: number;
  angles_deg?: readonly number[];
  gains_db?: readonly (readonly number[])[];
}

export interface Placed {
  get position(): Position;
  set position(position: Position);
  get orientation(): Orientation;
  set orientation(orientation: Orientation);
  /** Turns a level head or emitter: radians counter-clockwise from +x. */
  set yaw(yaw: number);
  /** Sets position and direction together. What is left out stays. */
  move(pose: Partial<Pose>): void;
}

export interface Emitter extends Placed {
  readonly id: string;
  /** Takes the sound of a live emitter; null if it plays a clip of the server. */
  readonly input: AudioNode | null;
  gainDb: number;
  /** Changes its gain by a ramp of so many seconds, linearly in decibels. */
  setGain(gainDb: number, options?: { rampS?: number }): void;
  /** Lets its clip fade out within `fadeS` seconds (0.01), from the clock `at` of the stream on or at once. The event "ended" follows. */
  stop(options?: StopOptions): void;
  /** Whether all sound of its clip has been heard. */
  readonly hasEnded: boolean;
  remove(): void;
}

export interface StopOptions {
  at?: number;
  fadeS?: number;
}

/** A listener beside the first of its stream. */
export interface Listener extends Placed {
  readonly id: string;
  /** What this listener hears, in two channels: connect it. */
  readonly output: AudioNode;
  /** From setting its pose to its sound, medians of the last seconds. */
  readonly latency: { direct: Latency | null; reverberation: Latency | null };
  /** Counts since it was added. */
  readonly statistics: Statistics;
  /** The last seconds that it heard, at most twelve. */
  capture(seconds: number): Promise<{ left: Float32Array; right: Float32Array }>;
  remove(): void;
}

/** Without a position, a listener begins where a visit of the scene does. */
export interface ListenerOptions extends Partial<Pose> {
  id?: string;
  /** One of GET /v1/hrtfs; without it, the server's own or that of the stream. */
  head?: string;
}

export interface EmitterOptions extends Pose {
  id?: string;
  /** One of GET /v1/clips. Without it, the emitter plays what `source` does or what is connected to its `input`. */
  clip?: string;
  source?: AudioNode;
  /** Whether a clip is played again and again; true if left out. */
  loop?: boolean;
  /** The clock of the stream (`sampleClock`) at which its clip begins, to the sample; at once if left out or over. */
  startAt?: number;
  /** The clock at which its clip fades out. */
  stopAt?: number;
  /** Where in its clip to begin, in seconds. */
  offsetS?: number;
  /** What of its clip is repeated, in seconds. */
  loopStartS?: number;
  loopEndS?: number;
  /** Whether it is removed once all of its sound has been heard. */
  removeWhenEnded?: boolean;
  /** For how long samples of a live emitter wait at the server, so that they may come unevenly: 2 to 250 milliseconds, two blocks if left out. */
  jitterMs?: number;
  gainDb?: number;
  directivity?: Directivity;
}

interface NafirEvents {
  state: CustomEvent<StateDetail>;
  refused: CustomEvent<Refusal>;
  level: CustomEvent<{ level: string; reason: string; listener?: string; [more: string]: unknown }>;
  effects: CustomEvent<{ decisions: readonly unknown[]; listener?: string; [more: string]: unknown }>;
  status: CustomEvent<{ listener?: string; [figure: string]: unknown }>;
  /** All sound of an emitter's clip has been heard. It is removed if it was to be, or if a new stream does not begin it again. */
  ended: CustomEvent<{ id: string; removed: boolean }>;
  /** A listener beside the first is gone, since a new connection may not have it again. */
  left: CustomEvent<{ id: string; code: string; message: string }>;
}

export interface Nafir extends EventTarget {
  /** What the first listener hears, in two channels: connect it. */
  readonly output: AudioNode;
  /** The first listener. */
  readonly listener: Placed;
  /** Those beside the first. */
  readonly listeners: ReadonlyMap<string, Listener>;
  readonly state: State;
  readonly welcome: Welcome | null;
  readonly emitters: ReadonlyMap<string, Emitter>;
  addEmitter(options: EmitterOptions): Emitter;
  removeEmitter(id: string): void;
  /** As `stop` of an emitter. */
  stopEmitter(id: string, options?: StopOptions): void;
  /** The clock that the stream has reached by now, in samples: about that of the frame after its newest block. It goes on over lost connections. */
  readonly sampleClock: number;
  /** Stores an audio file on the server. Resolves with the name by which an emitter plays it as its clip. Rejects with RequestError. */
  upload(file: Blob | BufferSource, options?: { title?: string }): Promise<string>;
  /** Deletes an uploaded clip. Emitters that play it go on. */
  deleteClip(name: string): Promise<void>;
  /** Adds a listener who hears the same emitters at the same time. Rejects with RefusedError if the server does not take it or it is not there within
      30 s, and with RangeError for an id or numbers that no server takes; the stream goes on. */
  addListener(options?: ListenerOptions): Promise<Listener>;
  removeListener(id: string): void;
  /** Chooses a quality level of the scene, or "auto". */
  set level(name: string);
  /** Opens a door of the scene so far, from 0, shut, to 1. `welcome.doors` has those there are. */
  setDoor(name: string, openness: number): void;
  /** Switches effects on or off by name; null leaves one to the server's plan. */
  setEffects(effects: Record<string, boolean | null>): void;
  /** From setting a pose to its sound, medians of the last seconds. */
  readonly latency: { direct: Latency | null; reverberation: Latency | null };
  /** Counts since the beginning. */
  readonly statistics: Statistics;
  /** The last seconds that were heard, at most twelve. */
  capture(seconds: number): Promise<{ left: Float32Array; right: Float32Array }>;
  close(): void;
  addEventListener<T extends keyof NafirEvents>(type: T, listener: (event: NafirEvents[T]) => void, options?: AddEventListenerOptions): void;
  addEventListener(type: string, listener: EventListenerOrEventListenerObject | null, options?: boolean | AddEventListenerOptions): void;
}

export interface OpusOptions {
  frame_ms?: 5 | 10 | 20;
  /** Of two channels, in bits per second. */
  bitrate?: number;
  complexity?: number;
  application?: "low_delay" | "audio" | "voip";
  signal?: "auto" | "voice" | "music";
}

export interface ConnectOptions {
  scene: string;
  /** An API key or token, if the server asks for one. */
  key?: string | null;
  /** Without it, where a visit of the scene begins. */
  listener?: Pose;
  level?: string;
  effects?: Record<string, boolean>;
  /** One of GET /v1/hrtfs. */
  head?: string;
  /** Of ambisonics, 1 to 3: turns of the head are then heard at once. */
  order?: 1 | 2 | 3;
  /** s16 takes half the bytes of f32, which is used if left out. opus takes a tenth, at 48 kHz; where server or browser do not have it, it is s16. Live
      emitters are sent in it as well. */
  encoding?: "f32" | "s16" | "opus";
  opus?: OpusOptions;
  bufferBlocks?: number;
  /** How many listeners there will be, the first included, so that the server keeps room for them. */
  listeners?: number;
  /** "here": the field runs in this browser, in ambisonics of the first order. */
  rendered?: "server" | "here";
  /** Ends the attempt. */
  signal?: AbortSignal;
  /** Where this package's files are, for bundlers that move them. */
  assets?: string | URL;
}

/** A stream that was refused, or a listener in it with the id `listener`; `code` is one of the server's error codes. */
export class RefusedError extends Error {
  readonly code: string | null;
  readonly listener: string | null;
}

/** A request over HTTP that failed. */
export class RequestError extends Error {
  readonly code: string;
  readonly status: number;
}

/** Opens a stream of a server and makes an AudioNode of it. Resolves when the server has welcomed it. */
export function connect(context: AudioContext, url: string | URL, options: ConnectOptions): Promise<Nafir>;

export interface RequestOptions {
  key?: string | null;
  signal?: AbortSignal;
}

/** Stores an audio file on a server, without a stream. Resolves with the name of the clip. Rejects with RequestError. */
export function uploadClip(server: string | URL, file: Blob | BufferSource, options?: RequestOptions & { title?: string }): Promise<string>;

/** Deletes an uploaded clip of a server. */
export function deleteClip(server: string | URL, name: string, options?: RequestOptions): Promise<void>;

/** An AudioNode with the sound of a microphone. Asks the user. */
export function microphone(context: AudioContext, constraints?: MediaTrackConstraints): Promise<MediaStreamAudioSourceNode>;
