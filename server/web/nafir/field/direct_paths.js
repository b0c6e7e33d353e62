// The direct sound of a scene: the shortest path from an emitter to a listener, and how it is heard. Unlike a response it is found in a tenth
// of a millisecond, so that who renders can do so itself. The arithmetic is the server's own.

import { FloorPlan } from "./floor_plan.js";
import { absorptionDbPerM, PlaneWaves } from "./plane_waves.js";

function planOf({ id, geometry, mesh, bounds: { minimum, maximum } }) {
  if (mesh) throw new Error(`scene ${id} is a triangle mesh, and only floor plans are computed in a browser`);
  if (geometry) return new FloorPlan({ corners: geometry.corners, height: geometry.height_m });
  const [[west, south, floor], [east, north, height]] = [minimum, maximum];
  return new FloorPlan({ corners: [[west, south], [east, south], [east, north], [west, north]], height, floor });
}

export class DirectPaths {
  #manifest;
  #sampleRate;

  /** `manifest` is scene.json. Throws Error for a scene that is no floor plan. */
  constructor({ manifest, sampleRate }) {
    this.#manifest = manifest;
    this.#sampleRate = sampleRate;
    const { speed_of_sound: speedOfSound = 343, air } = manifest;
    this.plan = planOf(manifest);
    this.speedOfSound = speedOfSound;
    this.waves = new PlaneWaves({ sampleRate, speedOfSound, airDbPerM: absorptionDbPerM(air) });
  }

  /** Throws RangeError for a position that is not inside the scene. */
  requireInside(position, name) {
    const { minimum, maximum } = this.#manifest.bounds;
    const isInBox = position.every((at, axis) => minimum[axis] <= at && at <= maximum[axis]);
    if (position.length === 3 && isInBox && this.plan.contains(position)) return;
    throw new RangeError(`${name} (${position.join(", ")}) is not inside scene ${this.#manifest.id}`);
  }

  /** {lengthM, arrival, gainDb, described}; see FloorPlan. */
  between(listener, emitter) {
    return this.plan.path(listener, emitter, this.speedOfSound);
  }

  /** What a DirectSound follows: {delay, filter, gains}, in samples and one gain for each channel [W, Y, Z, X]. Throws RangeError for a
      position that is not inside the scene. */
  heard(listener, emitter) {
    this.requireInside(listener, "listener");
    this.requireInside(emitter, "emitter");
    const path = this.between(listener, emitter);
    const [x, y, z] = path.arrival;
    return { delay: (path.lengthM / this.speedOfSound) * this.#sampleRate, filter: this.waves.filter(path), gains: [1, y, z, x] };
  }
}
