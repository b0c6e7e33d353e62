// Runs modules of server/web/nafir in Node for test_javascript.py: node javascript_driver.mjs MODULES VECTORS
// Prints as JSON what they make of the table of vectors.

import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [, , modules, vectors] = process.argv;
const load = (name) => import(new URL(name, `${pathToFileURL(modules)}/`));
const { buffersOf } = await load("channels.js");
const { parseBlock, serializeDryBlock, serializePose } = await load("wire.js");
const { bind, orientationToThree, poseOf, positionToThree } = await load("three.js");
const table = JSON.parse(readFileSync(vectors));
const hex = (buffer) => Buffer.from(buffer).toString("hex");
const bytes = (text) => Uint8Array.from(Buffer.from(text, "hex")).buffer;

/** What three.js has in matrixWorld for a position, a quaternion and a scale. */
function object([px, py, pz], [x, y, z, w], scale = 1) {
  const columns = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
    [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
    [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
  ];
  const elements = [...columns.flatMap((column) => [...column.map((value) => scale * value), 0]), px, py, pz, 1];
  return { matrixWorld: { elements }, updateWorldMatrix() {} };
}

const poses = table.poses.map(({ three, nafir }) => {
  const { position, orientation } = poseOf(object(three.position, three.rotation, 3));
  const back = [...positionToThree(nafir.position), ...orientationToThree(nafir.orientation)];
  return { here: [...position, ...orientation], back };
});

const { pose_id: poseId, position, orientation } = table.listener;
const dry = table.dry_blocks.filter(({ encoding }) => encoding === "f32");
const wet = table.audio_blocks.map(({ hex: text, encoding }) => {
  const block = parseBlock(bytes(text), encoding);
  const buffers = buffersOf(block.channels).length;
  return { ...block, buffers, channels: block.channels.map((samples) => Array.from(samples)) };
});
const damaged = [];
for (let size = 0; 2 * size < table.audio_blocks[0].hex.length; size++) {
  try {
    parseBlock(bytes(table.audio_blocks[0].hex.slice(0, 2 * size)));
    damaged.push(size);
  } catch (error) {
    if (!(error instanceof TypeError || error instanceof RangeError)) throw error;
  }
}

// A binding says a pose once, and again when it has changed.
const said = [];
const placed = (name) => ({ move: (pose) => said.push([name, ...pose.position]), remove: () => said.push([name, "removed"]) });
const nafir = { listener: placed("ears"), addEmitter: ({ clip }) => placed(clip) };
const camera = object([1, 2, 3], [0, 0, 0, 1]);
const ball = object([4, 5, 6], [0, 0, 0, 1]);
const binding = bind(nafir, camera);
binding.add(ball, { clip: "trumpet" });
binding.update();
binding.update();
ball.matrixWorld.elements[12] = 7;
binding.update();
binding.remove(ball);
binding.update();

console.log(
  JSON.stringify({
    poses,
    listener: hex(serializePose({ poseId, position, orientation })),
    byYaw: hex(serializePose({ poseId, position, yaw: 2 * Math.atan2(0.6, 0.8) })),
    dry: dry.map((each) => hex(serializeDryBlock({ ...each, samples: Float32Array.from(each.samples) }))),
    wet,
    damaged,
    said,
  }),
);
