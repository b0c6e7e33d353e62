// Requests to the server over HTTP: scenes, clips, heads and loudness maps. A server that asks for a key gets the one
// that the user gives.

import { getJson } from "./access.js";
import { decoderUrl } from "./nafir/http.js";

const BASE = new URL("v1/", document.baseURI);
const endpoint = (path) => new URL(path, BASE);

export const fetchScenes = () => getJson(endpoint("scenes"), { needed: true });
export const fetchScene = (id) => getJson(endpoint(`scenes/${encodeURIComponent(id)}`));
export const fetchFrontier = (id) => getJson(endpoint(`scenes/${encodeURIComponent(id)}/frontier`));
export const fetchClips = async () => (await getJson(endpoint("clips"))).clips;
export const fetchHeads = () => getJson(endpoint("hrtfs"));

/** The filters by which a head hears ambisonic channels: {hrtf, order, sample_rate, delay_samples, filters[ear][channel]}. */
export const fetchDecoder = (head, wanted) => getJson(decoderUrl(BASE, head, wanted));

/** The lines [x, y, x, y] in which a plane cuts the scene at a height. */
export async function fetchSection(scene, heightM) {
  const url = endpoint(`scenes/${encodeURIComponent(scene)}/section`);
  url.searchParams.set("height_m", heightM.toFixed(3));
  return (await getJson(url)).lines;
}

export function fetchLoudness(scene, { position, heightM, doors = {}, signal }) {
  const url = endpoint(`scenes/${encodeURIComponent(scene)}/loudness`);
  for (const [name, openness] of Object.entries(doors)) url.searchParams.append("door", `${name}=${openness}`);
  const query = { emitter: position.map((value) => value.toFixed(3)).join(","), height_m: heightM, format: "json" };
  for (const [key, value] of Object.entries(query)) url.searchParams.set(key, value);
  return getJson(url, { signal });
}

export function streamUrl() {
  const url = endpoint("stream");
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  return url.href;
}
