// Wire format of /v1/stream, protocol version 3: parsers and serialisers side by side.
// Units are metres and radians; everything binary is little endian.

export const PROTOCOL = 3;

const AUDIO_BLOCK = 1;
const LISTENER_POSE = 2;
const BLOCK_HEADER_BYTES = 28;
const POSE_BYTES = 36;
const CHANNELS = [1, 2, 4, 9, 16];

export const FLAG_LATE = 2;

/** A listener pose as a binary message. `position` is [x, y, z], and `yaw` turns counter-clockwise from +x. */
export function serializePose({ poseId, position, yaw }) {
  const buffer = new ArrayBuffer(POSE_BYTES);
  const view = new DataView(buffer);
  view.setUint8(0, LISTENER_POSE);
  view.setUint32(4, poseId, true);
  const floats = [...position, 0, 0, Math.sin(yaw / 2), Math.cos(yaw / 2)];
  floats.forEach((value, index) => view.setFloat32(8 + 4 * index, value, true));
  return buffer;
}

/** Whether a binary message is an audio block; a newer server may send other kinds. */
export const isBlock = (buffer) => buffer.byteLength > 0 && new DataView(buffer).getUint8(0) === AUDIO_BLOCK;

/**
 * An audio block as {flags, sequence, sampleClock, poseId, reverberationPoseId, frames, channels}. `channels` are Float32Array(frames):
 * both ears, equal if the block has one channel, or 4, 9 or 16 of ambisonics. The poses are the newest of the direct sound and of the
 * reflected field.
 */
export function parseBlock(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < BLOCK_HEADER_BYTES || view.getUint8(0) !== AUDIO_BLOCK) {
    throw new TypeError("not an audio block");
  }
  const count = view.getUint16(2, true);
  const frames = view.getUint32(24, true);
  if (!CHANNELS.includes(count) || buffer.byteLength !== BLOCK_HEADER_BYTES + frames * count * 4) {
    throw new TypeError(`audio block of ${buffer.byteLength} bytes for ${frames} frames, ${count} channels`);
  }
  const channels = Array.from({ length: Math.max(2, count) }, () => new Float32Array(frames));
  channels.forEach((samples, index) => {
    const first = BLOCK_HEADER_BYTES + 4 * Math.min(index, count - 1);
    for (let frame = 0; frame < frames; frame++) samples[frame] = view.getFloat32(first + 4 * count * frame, true);
  });
  return {
    flags: view.getUint8(1),
    sequence: view.getUint32(4, true),
    sampleClock: Number(view.getBigUint64(8, true)),
    poseId: view.getUint32(16, true),
    reverberationPoseId: view.getUint32(20, true),
    frames,
    channels,
  };
}

export const message = {
  hello: ({ scene, sampleRate, level, effects, output, order, head, listener, emitters }) =>
    JSON.stringify({
      type: "hello", protocol: PROTOCOL, scene, sample_rate: sampleRate, encoding: "f32", level, effects, output, order, hrtf: head, listener, emitters,
    }),
  setEffects: ({ effects, output }) => JSON.stringify({ type: "set_effects", effects, output }),
  setLevel: (level) => JSON.stringify({ type: "set_level", level }),
  addEmitter: ({ id, clip, position, gainDb }) => JSON.stringify({ type: "add_emitter", id, clip, position, gain_db: gainDb }),
  setGain: ({ id, gainDb }) => JSON.stringify({ type: "set_gain", id, gain_db: gainDb }),
  moveEmitter: ({ id, position, poseId }) => JSON.stringify({ type: "move_emitter", id, position, pose_id: poseId }),
  removeEmitter: (id) => JSON.stringify({ type: "remove_emitter", id }),
  acknowledge: (sequence) => JSON.stringify({ type: "acknowledge", sequence }),
};
