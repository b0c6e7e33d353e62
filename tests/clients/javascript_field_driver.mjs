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
const bytesOf = (path) => new Uint8Array(readFileSync(path));

function respond({ bundle, graph, noises, level, poses, into }) {
  const field = new Field({
    manifest: JSON.parse(readFileSync(join(bundle, "scene.json"), "utf8")),
    level: level ?? undefined,
    graph: graph && bytesOf(join(bundle, graph)),
    noises: noises && readRows(bytesOf(noises)),
  });
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

const TASKS = { respond, run, spectrum };
const results = JSON.parse(readFileSync(jobFile, "utf8")).map(({ task, ...job }) => {
  try {
    return TASKS[task](job);
  } catch (error) {
    return { error: error.message, kind: error.name };
  }
});
console.log(JSON.stringify(results));
