// Poses of three.js. Without an import of three: whatever has `matrixWorld` will do.
//
//   const ears = bind(nafir, camera);
//   ears.add(radio, { clip: "woman-reading" });
//   renderer.setAnimationLoop(() => { ears.update(); renderer.render(scene, camera); });
//
// three.js: x right, y up, z back; objects look along -z. Nafir: x east, y north, z up; the identity looks along +x.

/** A direction or position of three.js in the axes of the server. */
const toNafir = (x, y, z) => [x, -z, y];

/** Where a position [x, y, z] of the server is in three.js. */
export const positionToThree = ([x, y, z]) => [x, z, -y];

/** The quaternion [x, y, z, w] of three.js for an orientation of the server. */
export function orientationToThree([x, y, z, w]) {
  const half = Math.SQRT1_2; // sine and cosine of half the quarter turn from "ahead is north" to "ahead is east"
  return [half * (x - y), half * (z - w), -half * (x + y), half * (z + w)];
}

/** The pose {position, orientation} of an object as the server has it, wherever the object hangs in the scene and whatever its scale. */
export function poseOf(object) {
  object.updateWorldMatrix(true, false);
  const m = object.matrixWorld.elements; // column by column: the object's x, y and z axes, then its place
  const unit = (at, sign) => {
    const length = Math.hypot(m[at], m[at + 1], m[at + 2]);
    return toNafir((sign * m[at]) / length, (sign * m[at + 1]) / length, (sign * m[at + 2]) / length);
  };
  return { position: toNafir(m[12], m[13], m[14]), orientation: quaternion(unit(8, -1), unit(0, -1), unit(4, 1)) };
}

/** The quaternion that turns the axes of the world to `ahead`, `left` and `up`, unit vectors at right angles. */
function quaternion([ax, ay, az], [lx, ly, lz], [ux, uy, uz]) {
  // Of four times the square of each component, the largest: its root is divided by.
  const squares = [1 + ax - ly - uz, 1 - ax + ly - uz, 1 - ax - ly + uz, 1 + ax + ly + uz];
  const most = squares.indexOf(Math.max(...squares));
  const root = 2 * Math.sqrt(squares[most]);
  const [x, y, z] = [lz - uy, ux - az, ay - lx]; // times w
  const [xy, xz, yz] = [ay + lx, az + ux, lz + uy];
  const rows = [
    [squares[0], xy, xz, x],
    [xy, squares[1], yz, y],
    [xz, yz, squares[2], z],
    [x, y, z, squares[3]],
  ];
  return rows[most].map((value) => value / root);
}

/** Binds a listener to a camera, the first one unless another is given, and emitters to the objects that are added. `update` sends where they
    are now: call it in each frame. */
export function bind(nafir, camera, listener = nafir.listener) {
  const bound = new Map(); // object -> emitter
  const seen = new Map(); // object -> its last pose, as text
  const follow = (object, placed) => {
    const pose = poseOf(object);
    const text = JSON.stringify(pose);
    if (seen.get(object) === text) return;
    seen.set(object, text);
    placed.move(pose);
  };
  return {
    /** Adds an emitter at an object: options of nafir.addEmitter. */
    add(object, options) {
      const emitter = nafir.addEmitter({ ...options, ...poseOf(object) });
      bound.set(object, emitter);
      return emitter;
    },
    remove(object) {
      bound.get(object)?.remove();
      bound.delete(object);
      seen.delete(object);
    },
    update() {
      follow(camera, listener);
      for (const [object, emitter] of bound) follow(object, emitter);
    },
  };
}
