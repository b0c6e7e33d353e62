import type { Emitter, EmitterOptions, Nafir, Orientation, Placed, Position } from "./index.js";

/** An Object3D of three.js, as much of it as is needed. */
export interface Object3DLike {
  matrixWorld: { elements: ArrayLike<number> };
  updateWorldMatrix(updateParents: boolean, updateChildren: boolean): void;
}

export function positionToThree(position: Position): [number, number, number];
export function orientationToThree(orientation: Orientation): [number, number, number, number];
/** The pose of an object as the server has it. */
export function poseOf(object: Object3DLike): { position: Position; orientation: Orientation };

export interface Binding {
  /** Adds an emitter at an object. */
  add(object: Object3DLike, options: Omit<EmitterOptions, "position" | "orientation" | "yaw">): Emitter;
  remove(object: Object3DLike): void;
  /** Sends where camera and objects are now: call it in each frame. */
  update(): void;
}

/** Binds a listener to a camera: the first one, unless another is given. */
export function bind(nafir: Nafir, camera: Object3DLike, listener?: Placed): Binding;
