// The geometry of a scene: walls, sight, the shortest path of sound round corners, and the paths by way of one wall, the floor or the
// ceiling. The arithmetic is the server's own (server/acoustics/sound_path_kernel.py, reflections_kernel.py, diffraction.py).
//
// Points are [x, y, z] in metres, walls stand on the polygon `corners` ([x, y], counter-clockwise) from `floor` to `height`. Gains are in
// dB, in seven octave bands from 125 Hz to 8 kHz.

export const OCTAVE_BANDS_HZ = [125, 250, 500, 1000, 2000, 4000, 8000];

const TOUCH_M = 1e-9; // nearer to a wall than that is on it
const COINCIDENT_M = 1e-9;
const PENUMBRA_M = 0.05; // sight has fallen to 1 / e where the path round a corner is longer by this
const SOFTENED_M = 1e-4;
const CLEAR_FRESNEL_NUMBER = -0.1915871349; // below it, an edge causes no loss
const GRAZING_LOSS_DB = 5;

/** The gain in dB that the edge of a wall leaves (Kurze and Anderson, Applied Acoustics 4, 1971). */
function diffractionDb(fresnelNumber) {
  if (fresnelNumber <= CLEAR_FRESNEL_NUMBER) return 0;
  const x = Math.sqrt(2 * Math.PI * Math.abs(fresnelNumber));
  if (x < 1e-4) return -GRAZING_LOSS_DB;
  const bent = x / (fresnelNumber > 0 ? Math.tanh(x) : Math.tan(x));
  return Math.min(0, -(GRAZING_LOSS_DB + 20 * Math.log10(bent)));
}

export class FloorPlan {
  #bends; // corners where a path can bend
  #bendLengths; // [one][other] of the shortest paths between them

  constructor({ corners, height, floor = 0 }) {
    this.corners = corners;
    this.height = height;
    this.floor = floor;
    const next = (i) => corners[(i + 1) % corners.length];
    /** Walls as {x, y, ux, uy, extent}: where one begins, its direction, and its length. The room is on its left. */
    this.walls = corners.map(([x, y], i) => {
      const extent = Math.hypot(next(i)[0] - x, next(i)[1] - y);
      return { x, y, ux: (next(i)[0] - x) / extent, uy: (next(i)[1] - y) / extent, extent };
    });
    this.#bends = corners.filter(([x, y], i) => {
      const [px, py] = corners.at(i - 1);
      const [nx, ny] = next(i);
      return (x - px) * (ny - y) - (y - py) * (nx - x) < 0;
    });
    this.#bendLengths = this.#bends.map((one) => this.#bends.map((other) => this.#apart(one, other)));
    for (const [via, toVia] of this.#bendLengths.entries()) {
      for (const lengths of this.#bendLengths) {
        for (const [to, length] of toVia.entries()) lengths[to] = Math.min(lengths[to], lengths[via] + length);
      }
    }
  }

  /** An upper bound of the length of paths within the walls: from end to end along the bends, and the room's diagonal at both ends. */
  get longestM() {
    const spread = (axis) => Math.max(...this.corners.map((corner) => corner[axis])) - Math.min(...this.corners.map((corner) => corner[axis]));
    const bent = Math.max(0, ...this.#bendLengths.flat().filter(Number.isFinite));
    return bent + 2 * Math.hypot(spread(0), spread(1), this.height - this.floor);
  }

  #apart(one, other) {
    return this.sees(one, other) ? Math.hypot(other[0] - one[0], other[1] - one[1]) : Infinity;
  }

  /** Whether a point is within the walls in plan, or on them. */
  contains([x, y]) {
    let isInside = false;
    let [x0, y0] = this.corners.at(-1);
    for (const [x1, y1] of this.corners) {
      if (y0 > y !== y1 > y && x < x0 + ((y - y0) * (x1 - x0)) / (y1 - y0)) isInside = !isInside;
      [x0, y0] = [x1, y1];
    }
    if (isInside) return true;
    return this.corners.some(([x1, y1]) => {
      const [alongX, alongY] = [x1 - x0, y1 - y0];
      const share = Math.min(1, Math.max(0, ((x - x0) * alongX + (y - y0) * alongY) / (alongX ** 2 + alongY ** 2)));
      const touches = Math.hypot(x - x0 - share * alongX, y - y0 - share * alongY) < TOUCH_M;
      [x0, y0] = [x1, y1];
      return touches;
    });
  }

  /** Whether no wall stands between two points within the room. A line that grazes a corner is free. */
  sees([px, py], [qx, qy]) {
    const [rayX, rayY] = [qx - px, qy - py];
    let [x0, y0] = this.corners.at(-1);
    let start = rayX * (y0 - py) - rayY * (x0 - px);
    for (const [x1, y1] of this.corners) {
      const end = rayX * (y1 - py) - rayY * (x1 - px);
      if (start * end < -TOUCH_M) {
        const [wallX, wallY] = [x1 - x0, y1 - y0];
        const ofP = wallX * (py - y0) - wallY * (px - x0);
        const ofQ = wallX * (qy - y0) - wallY * (qx - x0);
        if (ofP * ofQ < -TOUCH_M) return false;
      }
      [x0, y0, start] = [x1, y1, end];
    }
    return this.contains([(px + qx) / 2, (py + qy) / 2]);
  }

  /** Lengths in plan from a listener: to each corner that it sees (`seen`), and to each by the shortest path (`to`), with the first corner of it. */
  #reach(listener) {
    const seen = this.#bends.map(([x, y]) => {
      const distance = Math.hypot(x - listener[0], y - listener[1]);
      return distance >= COINCIDENT_M && this.sees(listener, [x, y]) ? distance : Infinity;
    });
    const to = this.#bends.map(() => Infinity);
    const first = this.#bends.map(() => 0);
    for (let bend = 0; bend < to.length; bend++) {
      for (let via = 0; via < to.length; via++) {
        const length = seen[via] + this.#bendLengths[via][bend];
        if (length < to[bend]) [to[bend], first[bend]] = [length, via];
      }
    }
    return { seen, to, first };
  }

  /** The length in plan of the path round corners and the last of them: infinite and -1 if the emitter is seen, or if there is none. */
  #around({ to }, listener, emitter) {
    let [around, last] = [Infinity, -1];
    if (to.length === 0 || this.sees(listener, emitter)) return { around, last };
    this.#bends.forEach(([x, y], bend) => {
      const distance = Math.hypot(x - emitter[0], y - emitter[1]);
      if (distance >= COINCIDENT_M && to[bend] + distance < around && this.sees(emitter, [x, y])) {
        [around, last] = [to[bend] + distance, bend];
      }
    });
    return { around, last };
  }

  /** How much longer the path over the nearest corner is than the straight line to an emitter that is seen, for the loss at its edge. */
  #clearance(seen, listener, emitter) {
    const rise = emitter[2] - listener[2];
    const straight = Math.hypot(Math.hypot(emitter[0] - listener[0], emitter[1] - listener[1]), rise);
    let clearance = Infinity;
    this.#bends.forEach(([x, y], bend) => {
      const toListener = seen[bend];
      const toEmitter = Math.hypot(emitter[0] - x, emitter[1] - y);
      if (toListener === Infinity || toEmitter < COINCIDENT_M) return;
      const ahead = -((listener[0] - x) * (emitter[0] - x) + (listener[1] - y) * (emitter[1] - y));
      if (ahead <= 0) return;
      const detour = Math.max(0, Math.hypot(toListener + toEmitter, rise) - straight);
      clearance = Math.min(clearance, (detour * toListener * toEmitter) / ahead);
    });
    return clearance;
  }

  /**
   * The shortest path: {lengthM, arrival, gainDb, described}. `arrival` is a unit vector from the listener, `gainDb` what edges leave, and
   * `described` the six numbers by which networks are told the path.
   */
  path(listener, emitter, speedOfSound) {
    const reached = this.#reach(listener);
    const { around, last } = this.#around(reached, listener, emitter);
    const rise = emitter[2] - listener[2];
    const plan = Math.hypot(emitter[0] - listener[0], emitter[1] - listener[1]);
    const straight = Math.hypot(plan, rise);
    let [lengthM, arrival, detour] = [straight, [1, 0, 0], 0];
    let [after, before, level, sight] = [emitter, listener, plan, 1];
    if (last < 0) {
      if (straight >= COINCIDENT_M) arrival = listener.map((at, axis) => (emitter[axis] - at) / straight);
      detour = -this.#clearance(reached.seen, listener, emitter);
    } else {
      lengthM = Math.hypot(around, rise);
      const near = this.#bends[reached.first[last]];
      const scale = around / lengthM / reached.seen[reached.first[last]];
      arrival = [scale * (near[0] - listener[0]), scale * (near[1] - listener[1]), rise / lengthM];
      detour = Math.max(0, lengthM - straight);
      [after, before, level, sight] = [near, this.#bends[last], around, Math.exp(Math.min(0, plan - around) / PENUMBRA_M)];
    }
    const gainDb = OCTAVE_BANDS_HZ.map((frequency) => diffractionDb((2 * detour * frequency) / speedOfSound));
    const towards = ([x0, y0], [x1, y1]) => {
      const scale = 1 / (Math.hypot(x1 - x0, y1 - y0) + SOFTENED_M);
      return [(x1 - x0) * scale, (y1 - y0) * scale];
    };
    const described = [Math.hypot(level, rise), sight, ...towards(listener, after), ...towards(emitter, before)];
    return { lengthM, arrival, gainDb, described };
  }

  /** A lower bound of the path length of the first reflection, over all surfaces that face both ends. */
  firstEchoM(listener, emitter) {
    let least = Infinity;
    const take = (fromListener, fromEmitter) => {
      if (fromListener > -TOUCH_M && fromEmitter > -TOUCH_M) least = Math.min(least, fromListener * fromEmitter);
    };
    for (const { x, y, ux, uy } of this.walls) {
      const from = (point) => -uy * (point[0] - x) + ux * (point[1] - y);
      take(from(listener), from(emitter));
    }
    take(listener[2] - this.floor, emitter[2] - this.floor);
    take(this.height - listener[2], this.height - emitter[2]);
    const square = listener.reduce((sum, at, axis) => sum + (emitter[axis] - at) ** 2, 0);
    return Math.sqrt(Math.max(square + 4 * least, 0));
  }

  /** Paths by way of one surface: [{lengthM, arrival, surface}], where a surface is "walls", "floor" or "ceiling". */
  reflections(listener, emitter) {
    const [lx, ly, lz] = listener;
    const [ex, ey, ez] = emitter;
    const [dx, dy, dz] = [ex - lx, ey - ly, ez - lz];
    const found = [];
    for (const { x, y, ux, uy, extent } of this.walls) {
      // Distances from the wall, into the room, and positions along it.
      const [lOff, eOff] = [ux * (ly - y) - uy * (lx - x), ux * (ey - y) - uy * (ex - x)];
      if (lOff < -TOUCH_M || eOff < -TOUCH_M || lOff + eOff < COINCIDENT_M) continue;
      const [lAlong, eAlong] = [ux * (lx - x) + uy * (ly - y), ux * (ex - x) + uy * (ey - y)];
      const at = (lAlong * eOff + eAlong * lOff) / (lOff + eOff);
      if (at < 0 || at >= extent) continue;
      const mirror = [x + at * ux, y + at * uy];
      if (!(this.sees(listener, mirror) && this.sees(emitter, mirror))) continue;
      const lengthM = Math.sqrt((eAlong - lAlong) ** 2 + (lOff + eOff) ** 2 + dz ** 2);
      const arrival = [(dx + 2 * eOff * uy) / lengthM, (dy - 2 * eOff * ux) / lengthM, dz / lengthM];
      found.push({ lengthM, arrival, surface: "walls" });
    }
    if (!this.sees(listener, emitter)) return found;
    for (const surface of ["floor", "ceiling"]) {
      const climb = surface === "floor" ? -(lz + ez) : 2 * this.height - lz - ez;
      const lengthM = Math.sqrt(dx ** 2 + dy ** 2 + climb ** 2);
      if (lengthM < COINCIDENT_M) continue;
      found.push({ lengthM, arrival: [dx / lengthM, dy / lengthM, climb / lengthM], surface });
    }
    return found;
  }

  /** How many walls the straight line between two points goes through. Everything outside of the polygon is wall. */
  wallsBetween([px, py], [qx, qy]) {
    const [stepX, stepY] = [qx - px, qy - py];
    let crossed = 0;
    for (const [i, [x, y]] of this.corners.entries()) {
      const [nx, ny] = this.corners[(i + 1) % this.corners.length];
      const [alongX, alongY] = [nx - x, ny - y];
      const across = stepX * alongY - stepY * alongX;
      if (across === 0) continue;
      const onLine = ((x - px) * alongY - (y - py) * alongX) / across;
      const onWall = ((x - px) * stepY - (y - py) * stepX) / across;
      if (onLine > 0 && onLine < 1 && onWall >= 0 && onWall < 1) crossed++;
    }
    return Math.floor(crossed / 2);
  }
}
