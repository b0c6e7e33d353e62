// Requests to the server over HTTP: scenes, clips, heads and loudness maps. Problem documents become RequestError.

import { askForKey, authorized, key } from "./access.js";

const endpoint = (path) => new URL(`v1/${path}`, document.baseURI);
const NEEDS_KEY = 401;

export class RequestError extends Error {
  constructor(message, { code = "unreachable", status = 0 } = {}) {
    super(message);
    this.code = code;
    this.status = status;
  }
}

async function getJson(url, options) {
  const given = key();
  let response;
  try {
    response = await fetch(url, authorized(options, given));
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new RequestError("The server cannot be reached.");
  }
  if (response.ok) return response.json();
  const problem = await response.json().catch(() => ({}));
  if (response.status === NEEDS_KEY) {
    await askForKey(problem.detail, given);
    return getJson(url, options);
  }
  throw new RequestError(problem.detail || problem.title || `The server answered ${response.status}.`, {
    code: problem.code,
    status: response.status,
  });
}

export const fetchScenes = () => getJson(endpoint("scenes"));
export const fetchScene = (id) => getJson(endpoint(`scenes/${encodeURIComponent(id)}`));
export const fetchFrontier = (id) => getJson(endpoint(`scenes/${encodeURIComponent(id)}/frontier`));
export const fetchClips = async () => (await getJson(endpoint("clips"))).clips;
export const fetchHeads = () => getJson(endpoint("hrtfs"));

/** The filters by which a head hears ambisonic channels: {hrtf, order, sample_rate, delay_samples, filters[ear][channel]}. */
export function fetchDecoder(head, { order, sampleRate }) {
  const url = endpoint(`hrtfs/${encodeURIComponent(head)}/decoder`);
  for (const [key, value] of Object.entries({ order, sample_rate: sampleRate })) url.searchParams.set(key, value);
  return getJson(url);
}

export function fetchLoudness(scene, { position, heightM, signal }) {
  const url = endpoint(`scenes/${encodeURIComponent(scene)}/loudness`);
  const query = { emitter: position.map((value) => value.toFixed(3)).join(","), height_m: heightM, format: "json" };
  for (const [key, value] of Object.entries(query)) url.searchParams.set(key, value);
  return getJson(url, { signal });
}

export function streamUrl() {
  const url = endpoint("stream");
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  return url.href;
}
