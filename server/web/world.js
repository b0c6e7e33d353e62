// The contents of the scene: one listener and a few emitters, always in places where they may stand.
// Events: "listener", "emitter" (detail: the emitter), "gain" (likewise), "emitters" (one was added or removed), "limit" (the largest
// number of emitters has changed) and "door" (detail: the door).

import { Floor, distance, wrapAngle } from "./geometry.js";

export const GAIN_DB = { min: -24, max: 12 }; // of an emitter

const INSIDE_M = 1e-4;
const LETTERS = [..."ABCDEFGHIJKLMNOPQRSTUVWXYZ"];
const IDS = [...LETTERS, ...LETTERS.flatMap((first) => LETTERS.map((second) => first + second))];

export class World extends EventTarget {
  #mostEmitters;

  /** `mostEmitters` is the largest number that the server takes. */
  constructor(scene, { mostEmitters }) {
    super();
    this.scene = scene;
    this.#mostEmitters = mostEmitters;
    const { minimum, maximum } = scene.bounds;
    const clearance = scene.walls_known ? undefined : null;
    // Poses are sent in single precision, which may round a place on the bounds to outside of them.
    const [west, south, east, north] = [minimum[0] + INSIDE_M, minimum[1] + INSIDE_M, maximum[0] - INSIDE_M, maximum[1] - INSIDE_M];
    this.floor = new Floor({ corners: scene.corners, minimum: [west, south], maximum: [east, north], clearance });
    this.listener = { position: [...scene.listener.position], yaw: scene.listener.yaw ?? 0 };
    this.emitters = new Map();
    this.doors = new Map((scene.doors ?? []).map((door) => [door.name, { ...door }]));
  }

  /** Opens a door so far, from 0, shut, to 1. */
  setDoor(name, openness) {
    const door = this.doors.get(name);
    const share = Math.min(1, Math.max(0, Math.round(1000 * openness) / 1000));
    if (!door || door.openness === share) return;
    door.openness = share;
    this.#emit("door", door);
  }

  /** How far each door is open, by name; undefined if there are none. */
  get openness() {
    return this.doors.size === 0 ? undefined : Object.fromEntries([...this.doors.values()].map(({ name, openness }) => [name, openness]));
  }

  #emit(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  /** Moves and turns the listener. `point` is [x, y] or [x, y, z]; either argument may be left out. */
  moveListener(point, yaw) {
    const { position } = this.listener;
    if (point) this.#place(position, point);
    if (yaw !== undefined) this.listener.yaw = wrapAngle(yaw);
    this.#emit("listener", this.listener);
  }

  moveEmitter(id, point) {
    const emitter = this.emitters.get(id);
    this.#place(emitter.position, point);
    this.#emit("emitter", emitter);
  }

  #place(position, point) {
    const { minimum, maximum } = this.scene.bounds;
    [position[0], position[1]] = this.floor.slide([position[0], position[1]], [point[0], point[1]]);
    if (point.length > 2) position[2] = Math.min(maximum[2], Math.max(minimum[2], point[2]));
  }

  setClip(id, clip) {
    const emitter = this.emitters.get(id);
    emitter.clip = clip;
    this.#emit("emitter", emitter);
  }

  /** Sets an emitter's gain in decibels relative to the clip as recorded. */
  setGain(id, gainDb) {
    const emitter = this.emitters.get(id);
    emitter.gainDb = gainDb;
    this.#emit("emitter", emitter);
    this.#emit("gain", emitter);
  }

  get mostEmitters() {
    return this.#mostEmitters;
  }

  set mostEmitters(most) {
    if (most === this.#mostEmitters) return;
    this.#mostEmitters = most;
    this.#emit("limit");
  }

  get isFull() {
    return this.emitters.size >= this.#mostEmitters;
  }

  /** Adds an emitter named by the first free letter, at `position` or where there is most room. */
  addEmitter({ clip, position, gainDb = 0 }) {
    const id = IDS.find((each) => !this.emitters.has(each));
    const height = this.scene.emitter.position[2];
    const emitter = { id, clip, position: position ? [...position] : [...this.#roomiest(), height], gainDb };
    this.emitters.set(id, emitter);
    this.#emit("emitters");
    return emitter;
  }

  removeEmitter(id) {
    this.emitters.delete(id);
    this.#emit("emitters");
  }

  #roomiest() {
    const { minimum, maximum, corners } = this.floor;
    const open = this.floor.clearance === null ? this.floor : new Floor({ corners, minimum, maximum, clearance: 0.7 });
    const taken = [this.listener.position, ...[...this.emitters.values()].map(({ position }) => position)];
    const spread = ([x, y]) => Math.min(...taken.map((position) => distance(position, [x, y])));
    let best = null;
    for (let x = minimum[0]; x <= maximum[0]; x += 0.2) {
      for (let y = minimum[1]; y <= maximum[1]; y += 0.2) {
        if (open.allows([x, y]) && (!best || spread([x, y]) > spread(best))) best = [x, y];
      }
    }
    return best ?? [this.listener.position[0], this.listener.position[1]];
  }

  /** An emitter relative to the listener: distance in metres and bearing in radians, positive to the left. */
  bearing({ position }) {
    const [x, y] = this.listener.position;
    const angle = Math.atan2(position[1] - y, position[0] - x) - this.listener.yaw;
    return { distanceM: distance(position, [x, y]), bearing: wrapAngle(angle) };
  }
}
