// Computes what a job file asks for with the field modules in FOLDER: `node javascript_field_driver.mjs FOLDER JOB.json`. Says the results as
// JSON, and writes samples of responses to the job's `into`.

import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [folder, jobFile] = process.argv.slice(2);
const load = (name) => import(pathToFileURL(join(folder, "field", name)).href);
const { Field, readRows } = await load("field.js");
const { Network } = await load("network.js");
const { inverse, transform } = await load("fourier.js");
const { LocalStream } = await load("local_stream.js");
const { Convolver, spectraOf } = await load("renderer.js");
const { Resampler } = await load("resampler.js");
const { blockSizeAt } = await load("../wire.js");
const bytesOf = (path) => new Uint8Array(readFileSync(path));

const open = ({ bundle, graph, noises, level, sampleRate }) =>
  new Field({
    manifest: JSON.parse(readFileSync(join(bundle, "scene.json"), "utf8")),
    level: level ?? undefined,
    sampleRate: sampleRate ?? undefined,
    graph: graph && bytesOf(join(bundle, graph)),
    noises: noises && readRows(bytesOf(noises)),
  });

function respond({ poses, into, ...opened }) {
  const field = open(opened);
  const samples = new Float32Array(poses.length * 4 * field.samples);
  poses.forEach(({ listener, emitter, orientation }, i) => {
    field.response(listener, emitter, orientation ?? null).forEach((channel, k) => samples.set(channel, (4 * i + k) * field.samples));
  });
  writeFileSync(into, samples);
  return { level: field.level, sampleRate: field.sampleRate, samples: field.samples };
}

function run({ graph, inputs }) {
  const given = Object.entries(inputs).map(([name, { dims, data }]) => [name, { dims, data: Float32Array.from(data) }]);
  const outputs = new Network(bytesOf(graph)).run(Object.fromEntries(given));
  return Object.fromEntries(Object.entries(outputs).map(([name, { dims, data }]) => [name, { dims, data: Array.from(data) }]));
}

function spectrum({ re, im }) {
  const [a, b] = [Float64Array.from(re), Float64Array.from(im)];
  transform(a, b);
  const there = [Array.from(a), Array.from(b)];
  inverse(a, b);
  return { there, back: [Array.from(a), Array.from(b)] };
}

/** Resamples a file of float32 with a number of channels, one after the other. */
function resample({ signal, channels: count, from, to, into }) {
  const all = new Float32Array(bytesOf(signal).buffer);
  const samples = all.length / count;
  const channels = Array.from({ length: count }, (_, k) => all.subarray(k * samples, (k + 1) * samples));
  const resampler = new Resampler({ from, to, samples });
  const resampled = new Float32Array(count * resampler.samples);
  resampler.resample(channels).forEach((channel, k) => resampled.set(channel, k * resampler.samples));
  writeFileSync(into, resampled);
  return { samples: resampler.samples };
}

/** A field_worker.js that answers at once, or once `hold` is null again. */
function answerer(field, stream, hold) {
  const block = blockSizeAt(field.sampleRate);
  return ({ type, id, poseId, listener, emitter }) => {
    if (type === "open") stream().receive({ type: "opened", level: field.level, manifest: field.manifest, samples: field.samples, ms: 1 });
    if (type !== "place") return;
    const respond = () => stream().receive({ type: "response", id, poseId, spectra: spectraOf(field.reflections(listener, emitter), block), ms: 1 });
    if (hold.responses) hold.responses.push(respond);
    else respond();
  };
}

/** Renders blocks; `script` has the commands before a block, by its number. The clip is a file of float32, and comes after `soundAfter` ticks. */
function stream({ blocks, script, clip, soundAfter = 0, into, ...opened }) {
  const field = open(opened);
  const size = blockSizeAt(field.sampleRate);
  const told = { posed: [], refused: [], state: [], status: [], heard: [] };
  const samples = new Float32Array(4 * blocks * size);
  let time = 1000;
  const { process } = Convolver.prototype;
  let convolved = 0; // in this block
  let most = 0; // in any
  Convolver.prototype.process = function (...given) {
    convolved += 1;
    return process.apply(this, given);
  };
  function obey(commands) {
    for (const { listener: moved, emitter, remove, feed, wait, hold: holds } of commands) {
      if (holds) hold.responses = [];
      if (moved) local.setListener({ ...moved, at: time });
      if (emitter) local.setEmitter({ ...emitter, at: time });
      if (remove) local.removeEmitter(remove);
      if (feed) local.feed(feed.id, Float32Array.from(feed.samples));
      if (wait) time += wait;
      if (holds === false) for (const respond of hold.responses.splice(0)) respond();
    }
  }
  const hold = { responses: null };
  let rendered = 0;
  const block = ({ channels, poseId, reverberationPoseId, late }) => {
    told.heard.push([poseId, reverberationPoseId, late]);
    if (rendered < blocks) channels.forEach((channel, k) => samples.set(channel, k * blocks * size + rendered * size));
    rendered += 1;
    if (rendered > 1) most = Math.max(most, convolved); // what was rehearsed comes before the first
    convolved = 0;
    obey(script[rendered] ?? []);
  };
  const keep = (name) => (detail) => told[name].push(detail);
  const listeners = { block, posed: keep("posed"), refused: keep("refused"), state: keep("state"), status: keep("status") };
  let local = null;
  const waiting = [];
  const answer = answerer(field, () => local, hold);
  const { listener } = script[0][0];
  const hello = { scene: "any", sampleRate: field.sampleRate };
  local = new LocalStream({
    server: "http://any", hello, listener: { ...listener, at: time }, emitters: [], listeners, now: () => time,
    tell: (message) => (local ? answer(message) : waiting.push(message)),
  });
  waiting.forEach(answer);
  let ticks = 0;
  let begun = null; // the tick before the first block
  for (obey(script[0]); rendered < blocks && ticks < 10 * blocks + 1000; ticks++) {
    if (clip && ticks === soundAfter) local.setSound({ name: "clip", samples: new Float32Array(bytesOf(clip).buffer) });
    local.tick();
    if (rendered > 0) begun ??= { ticks, atOnce: rendered };
    time += (1000 * size) / field.sampleRate;
  }
  Convolver.prototype.process = process;
  writeFileSync(into, samples);
  return { ...told, block: size, rendered, begun, most };
}

const TASKS = { respond, run, spectrum, resample, stream };
const results = JSON.parse(readFileSync(jobFile, "utf8")).map(({ task, ...job }) => {
  try {
    return TASKS[task](job);
  } catch (error) {
    return { error: error.message, kind: error.name };
  }
});
console.log(JSON.stringify(results));
