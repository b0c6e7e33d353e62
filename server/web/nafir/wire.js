// Wire format of /v1/stream, protocol version 3: parsers and serialisers side by side.
// Units are metres and radians; everything binary is little endian.

import { newChannels } from "./channels.js";

export const PROTOCOL = 3;

const AUDIO_BLOCK = 1;
const LISTENER_POSE = 2;
const DRY_BLOCK = 3;
const BLOCK_HEADER_BYTES = 28;
const POSE_BYTES = 36;
const DRY_HEADER_BYTES = 12;
const FULL_SCALE = 32767; // of s16
const CHANNELS = [1, 2, 4, 9, 16];

export const FLAG_LATE = 2;
export const FLAG_RESTART = 8; // of Opus: decoders begin anew

/** [x, y, z, w] of a pose that has it as `orientation`, or a `yaw` counter-clockwise from +x, or neither. */
export const orientationOf = ({ orientation, yaw = 0 }) => orientation ?? [0, 0, Math.sin(yaw / 2), Math.cos(yaw / 2)];

/** A listener pose as a binary message. `position` is [x, y, z]; the direction is an orientation or a yaw. `number` is that of a listener
    beside the first. */
export function serializePose({ poseId, position, number = 0, ...direction }) {
  const buffer = new ArrayBuffer(POSE_BYTES);
  const view = new DataView(buffer);
  view.setUint8(0, LISTENER_POSE);
  view.setUint8(1, number);
  view.setUint32(4, poseId, true);
  const floats = [...position, ...orientationOf(direction)];
  floats.forEach((value, index) => view.setFloat32(8 + 4 * index, value, true));
  return buffer;
}

const ENCODINGS = { f32: 0, s16: 1, opus: 2 }; // of dry blocks

/** A dry block of so many bytes after its header and id: its view, and where they begin. */
function dryBlock({ id, sequence, frames, encoding, bytes }) {
  const name = new TextEncoder().encode(id);
  const start = DRY_HEADER_BYTES + 4 * Math.ceil(name.length / 4);
  const view = new DataView(new ArrayBuffer(start + bytes));
  view.setUint8(0, DRY_BLOCK);
  view.setUint8(1, ENCODINGS[encoding]);
  view.setUint16(2, name.length, true);
  view.setUint32(4, sequence, true);
  view.setUint32(8, frames, true);
  new Uint8Array(view.buffer).set(name, DRY_HEADER_BYTES);
  return { view, start };
}

/** The next mono samples (Float32Array) of a live emitter, as f32 or s16. `sequence` rises from block to block. */
export function serializeDryBlock({ id, sequence, samples, encoding = "f32" }) {
  const width = encoding === "s16" ? 2 : 4;
  const { view, start } = dryBlock({ id, sequence, frames: samples.length, encoding, bytes: width * samples.length });
  samples.forEach((sample, index) => {
    if (width === 4) view.setFloat32(start + 4 * index, sample, true);
    else view.setInt16(start + 2 * index, Math.round(FULL_SCALE * Math.min(1, Math.max(-1, sample || 0))), true);
  });
  return view.buffer;
}

/** The next packet of Opus of a live emitter, which decodes to so many `frames`. `sequence` rises by one from block to block. */
export function serializeDryPacket({ id, sequence, frames, packet }) {
  const { view, start } = dryBlock({ id, sequence, frames, encoding: "opus", bytes: 2 + packet.length });
  view.setUint16(start, packet.length, true);
  new Uint8Array(view.buffer).set(packet, start + 2);
  return view.buffer;
}

/** Whether a binary message is an audio block; a newer server may send other kinds. */
export const isBlock = (buffer) => buffer.byteLength > 0 && new DataView(buffer).getUint8(0) === AUDIO_BLOCK;

/** Frames of a block at a sample rate: it lasts about 10 ms, so that poses are heard and partitions are cut as they are at 24 kHz. */
export const blockSizeAt = (sampleRate) => (sampleRate < 36_000 ? 256 : sampleRate < 72_000 ? 512 : 1024);

function parseHeader(view) {
  if (view.byteLength < BLOCK_HEADER_BYTES || view.getUint8(0) !== AUDIO_BLOCK) throw new TypeError("not an audio block");
  return {
    flags: view.getUint8(1),
    number: view.getUint8(3),
    sequence: view.getUint32(4, true),
    sampleClock: Number(view.getBigUint64(8, true)),
    poseId: view.getUint32(16, true),
    reverberationPoseId: view.getUint32(20, true),
    frames: view.getUint32(24, true),
  };
}

/**
 * An audio block as {flags, number, sequence, sampleClock, poseId, reverberationPoseId, frames, channels}. `channels` are
 * Float32Array(frames): both ears, equal if the block has one channel, or 4, 9 or 16 of ambisonics. `number` is that of the listener who
 * hears it, 0 for the first. The poses are the newest of the direct sound and of the reflected field. `encoding` is that of the welcome:
 * f32 or s16.
 */
export function parseBlock(buffer, encoding = "f32") {
  const view = new DataView(buffer);
  const header = parseHeader(view);
  const { frames } = header;
  const count = view.getUint8(2);
  const bytes = encoding === "s16" ? 2 : 4;
  if (!CHANNELS.includes(count) || buffer.byteLength !== BLOCK_HEADER_BYTES + frames * count * bytes) {
    throw new TypeError(`audio block of ${buffer.byteLength} bytes for ${frames} frames, ${count} channels`);
  }
  const channels = newChannels(Math.max(2, count), frames);
  channels.forEach((samples, index) => {
    let at = BLOCK_HEADER_BYTES + bytes * Math.min(index, count - 1);
    for (let frame = 0; frame < frames; frame++, at += bytes * count) {
      samples[frame] = bytes === 2 ? view.getInt16(at, true) / FULL_SCALE : view.getFloat32(at, true);
    }
  });
  return { ...header, channels };
}

/** An audio block in Opus: its header as above, without channels, and its packets, each a Uint8Array. */
export function parsePackets(buffer) {
  const view = new DataView(buffer);
  const header = parseHeader(view);
  const packets = [];
  for (let at = BLOCK_HEADER_BYTES; at < buffer.byteLength; ) {
    const length = at + 2 <= buffer.byteLength ? view.getUint16(at, true) : 0;
    at += 2;
    if (length === 0 || at + length > buffer.byteLength) throw new TypeError(`packet ${packets.length} of an audio block is incomplete`);
    packets.push(new Uint8Array(buffer, at, length));
    at += length;
  }
  return { header, packets };
}

export const message = {
  hello: ({ scene, sampleRate, encoding = "f32", opus, level, effects, output, order, head, bufferBlocks, listener, emitters, listeners, doors }) =>
    JSON.stringify({
      type: "hello", protocol: PROTOCOL, scene, sample_rate: sampleRate, block_size: sampleRate && blockSizeAt(sampleRate), encoding, opus, level,
      effects, output, order, hrtf: head, buffer_blocks: bufferBlocks, listener, emitters, listeners, doors, snapshots: true,
    }),
  resume: ({ token, snapshot, sequence, sampleClock }) =>
    JSON.stringify({ type: "resume", protocol: PROTOCOL, token, snapshot, sequence, sample_clock: sampleClock }),
  setEffects: ({ effects, output }) => JSON.stringify({ type: "set_effects", effects, output }),
  setDoor: ({ name, openness }) => JSON.stringify({ type: "set_door", door: name, openness }),
  setLevel: (level) => JSON.stringify({ type: "set_level", level }),
  addEmitter: ({
    id, clip, live, loop, position, orientation, directivity, gainDb, startAt, stopAt, offsetS, loopStartS, loopEndS, removeWhenEnded, jitterMs,
  }) =>
    JSON.stringify({
      type: "add_emitter", id, clip, live, loop, position, orientation, directivity, gain_db: gainDb, start_at: startAt, stop_at: stopAt,
      offset_s: offsetS, loop_start_s: loopStartS, loop_end_s: loopEndS, remove_when_ended: removeWhenEnded, jitter_ms: jitterMs,
    }),
  setGain: ({ id, gainDb, rampS }) => JSON.stringify({ type: "set_gain", id, gain_db: gainDb, ramp_s: rampS }),
  stopEmitter: ({ id, stopAt, fadeS }) => JSON.stringify({ type: "stop_emitter", id, stop_at: stopAt, fade_s: fadeS }),
  moveEmitter: ({ id, position, orientation, poseId }) => JSON.stringify({ type: "move_emitter", id, position, orientation, pose_id: poseId }),
  removeEmitter: (id) => JSON.stringify({ type: "remove_emitter", id }),
  addListener: ({ id, head, position, orientation }) => JSON.stringify({ type: "add_listener", id, hrtf: head, position, orientation }),
  removeListener: (id) => JSON.stringify({ type: "remove_listener", id }),
  acknowledge: (sequence, listener) => JSON.stringify({ type: "acknowledge", sequence, listener }),
};
