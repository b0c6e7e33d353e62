// The worker that computes responses for a scene that is rendered in the browser. It keeps the newest pose of each emitter alone, and computes
// one response at a time.

import { Field } from "./field.js";
import { spectraOf } from "./renderer.js";

const WARM_UP = 6; // responses before the first that is heard: code that runs for the first time is slow

let field = null;
let quantum = 0;
const placed = new Map(); // emitter id -> {listener, emitter, poseId}; in the order in which responses are computed
const spare = []; // spectra to write into
const { port1, port2 } = new MessageChannel();
let isBusy = false;

async function open({ server, scene, level, key, sampleRate, block }) {
  try {
    field = await Field.load(server, scene, { level, sampleRate, key });
    quantum = block;
    const { listener, emitter } = field.start;
    let ms = 0;
    for (let i = 0; i < WARM_UP; i++) ms = compute(listener, emitter).ms;
    self.postMessage({ type: "opened", level: field.level, manifest: field.manifest, samples: field.samples, ms });
  } catch ({ code = null, message, status }) {
    self.postMessage({ type: "failed", code, message, needsKey: status === 401 });
  }
}

/** Takes the newest poses of an emitter and of the listener. One that waits for a response keeps its turn. */
function place({ id, ...pose }) {
  placed.set(id, pose);
  if (!isBusy) {
    isBusy = true;
    port2.postMessage(null);
  }
}

function compute(listener, emitter) {
  const start = performance.now();
  const spectra = spectraOf(field.reflections(listener, emitter), quantum, spare.pop());
  return { spectra, ms: performance.now() - start };
}

port1.onmessage = () => {
  const [next] = placed;
  if (next) {
    const [id, { listener, emitter, poseId }] = next;
    placed.delete(id);
    try {
      const { spectra, ms } = compute(listener, emitter);
      self.postMessage({ type: "response", id, poseId, spectra, ms }, [spectra.buffer]);
    } catch (error) {
      self.postMessage({ type: "refused", id, message: error.message });
    }
  }
  // By a message to itself, so that poses that have arrived come first.
  isBusy = placed.size > 0;
  if (isBusy) port2.postMessage(null);
};

const commands = {
  open,
  place,
  remove: ({ id }) => placed.delete(id),
  spare: ({ spectra }) => spare.length < 4 && spare.push(spectra),
};

self.onmessage = ({ data: { type, ...detail } }) => commands[type](detail);
