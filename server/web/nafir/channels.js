// Samples of audio blocks as they go from thread to thread: all channels of a block are views of one buffer, which is transferred and not
// copied. A browser keeps what a message brought until it looks for garbage, and freeing thousands of buffers then would stop the audio
// thread for tens of milliseconds.

/** A Float32Array(frames) for each of `count` channels. */
export function newChannels(count, frames) {
  const all = new Float32Array(count * frames);
  return Array.from({ length: count }, (_, channel) => all.subarray(channel * frames, (channel + 1) * frames));
}

/** The buffers of channels, to be transferred with them. */
export const buffersOf = (channels) => [...new Set(channels.map(({ buffer }) => buffer))];

/** Frees the memory of channels that have been read, where the browser can. */
export function release(channels) {
  for (const buffer of buffersOf(channels)) buffer.transfer?.(0);
}
