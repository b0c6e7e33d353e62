// Sounds of the visitor: the microphone, and files that are decoded here. They are sent to the server as live sound while they are heard,
// and are kept nowhere. Emits "added" with a sound, {name, title}, and "refused" with the reason.

import { microphone } from "./nafir/microphone.js";

const MOST_BYTES = 64 * 2 ** 20;
const MOST_S = 600;
const USUAL_HZ = 48_000; // at which a file is decoded at first; where it is played at another rate, it is decoded for that
const MICROPHONE = "own:microphone";
const REASONS = {
  NotAllowedError: "The browser may not use the microphone.",
  NotFoundError: "There is no microphone.",
  NotSupportedError: "This browser cannot use the microphone at the sample rate of the stream.",
};

export const isOwn = (name) => name.startsWith("own:");

export class OwnSounds extends EventTarget {
  #sounds = new Map(); // name -> {title, make(context)}, which makes an AudioNode
  #players = new Map(); // emitter id -> {name, node, tap}
  #count = 0;

  /** What can be chosen: {name, title} each. */
  get all() {
    return [...this.#sounds].map(([name, { title }]) => ({ name, title }));
  }

  /** Adds the microphone, once the visitor allows it. */
  async addMicrophone() {
    if (this.#sounds.has(MICROPHONE)) {
      this.#added(MICROPHONE);
      return;
    }
    try {
      // Asked for here, after a click. Each stream takes the microphone anew, since an AudioContext of another rate may follow.
      const asked = await navigator.mediaDevices.getUserMedia({ audio: true });
      for (const track of asked.getTracks()) track.stop();
      this.#sounds.set(MICROPHONE, { title: "Your microphone", make: microphone });
      this.#added(MICROPHONE);
    } catch (error) {
      this.#refuse(navigator.mediaDevices ? (REASONS[error.name] ?? error.message) : "A microphone needs https, or a server on this computer.");
    }
  }

  /** Adds a sound file; `place` goes into the event. */
  async addFile(file, place = null) {
    if (file.size > MOST_BYTES) {
      this.#refuse(`${file.name} has more than ${MOST_BYTES / 2 ** 20} MB.`);
      return;
    }
    const decodedAt = async (rate) => new OfflineAudioContext(1, 1, rate).decodeAudioData(await file.arrayBuffer());
    let buffer;
    try {
      buffer = await decodedAt(USUAL_HZ);
    } catch {
      this.#refuse(`${file.name} is no sound that this browser can read.`);
      return;
    }
    if (buffer.duration > MOST_S) {
      this.#refuse(`${file.name} is longer than ${MOST_S / 60} minutes.`);
      return;
    }
    const make = async (context) => {
      // A buffer of another rate would be played by linear interpolation.
      if (buffer.sampleRate !== context.sampleRate) buffer = await decodedAt(context.sampleRate);
      const node = new AudioBufferSourceNode(context, { buffer, loop: true });
      node.start();
      return node;
    };
    const name = `own:${++this.#count}`;
    this.#sounds.set(name, { title: file.name, make });
    this.#added(name, place);
  }

  #added(name, place = null) {
    this.dispatchEvent(new CustomEvent("added", { detail: { name, title: this.#sounds.get(name).title, place } }));
  }

  #refuse(reason) {
    this.dispatchEvent(new CustomEvent("refused", { detail: reason }));
  }

  /** Plays a sound for an emitter into `tap`, an AudioNode, in place of what it has played. */
  async play(id, name, context, tap) {
    this.stop(id);
    const player = { name, tap, node: null };
    this.#players.set(id, player);
    try {
      const node = await this.#sounds.get(name).make(context);
      if (this.#players.get(id) !== player) {
        silence(node);
        return;
      }
      player.node = node;
      node.connect(tap.node);
    } catch (error) {
      this.#refuse(REASONS[error.name] ?? error.message);
    }
  }

  /** What an emitter plays now; undefined for a clip of the server. */
  played(id) {
    return this.#players.get(id)?.name;
  }

  stop(id) {
    const player = this.#players.get(id);
    this.#players.delete(id);
    if (player?.node) silence(player.node);
    player?.tap.end();
  }

  stopAll() {
    for (const id of [...this.#players.keys()]) this.stop(id);
  }
}

/** Ends a node for good, and gives the microphone back. */
function silence(node) {
  node.disconnect();
  node.stop?.();
  for (const track of node.mediaStream?.getTracks() ?? []) track.stop();
}
