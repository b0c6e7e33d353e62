// Requests to a server over HTTP. Problem documents become RequestError.

export class RequestError extends Error {
  constructor(message, { code = "unreachable", status = 0 } = {}) {
    super(message);
    this.code = code;
    this.status = status;
  }
}

/** The address of v1/ of a server, given as its own address or as that of its stream. */
export function apiOf(url) {
  const address = new URL(url, globalThis.location?.href);
  address.protocol = address.protocol.replace(/^ws/, "http");
  address.pathname = address.pathname.replace(/\/?(v1(\/stream)?\/?)?$/, "/v1/");
  address.search = address.hash = "";
  return address;
}

/** The options of a request, with a key if there is one. */
export function authorized(options = {}, key = null) {
  return key === null ? options : { ...options, headers: { ...options.headers, Authorization: `Bearer ${key}` } };
}

async function answered(url, { key = null, ...options }) {
  let response;
  try {
    response = await fetch(url, authorized(options, key));
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new RequestError("The server cannot be reached.");
  }
  if (response.ok) return response;
  const problem = await response.json().catch(() => ({}));
  throw new RequestError(problem.detail || problem.title || `The server answered ${response.status}.`, {
    code: problem.code,
    status: response.status,
  });
}

/** What the server says at `url`. Throws RequestError if it refuses or cannot be reached, and AbortError if `options.signal` says so. */
export const fetchJson = async (url, options = {}) => (await answered(url, options)).json();

/** The file at `url` as a Uint8Array. Throws as fetchJson. */
export const fetchBytes = async (url, options = {}) => new Uint8Array(await (await answered(url, options)).arrayBuffer());

/** Stores an audio file (a Blob, ArrayBuffer or typed array) on a server. Resolves with the name by which an emitter plays it as its clip. Throws as
    fetchJson. */
export async function uploadClip(server, file, { title, key = null, signal } = {}) {
  const url = new URL("clips", apiOf(server));
  if (title) url.searchParams.set("title", title);
  const headers = { "Content-Type": "application/octet-stream" };
  return (await fetchJson(url, { method: "POST", body: file, headers, key, signal })).name;
}

/** Deletes an uploaded clip. Emitters that play it go on. Throws as fetchJson. */
export async function deleteClip(server, name, { key = null, signal } = {}) {
  await answered(new URL(`clips/${encodeURIComponent(name)}`, apiOf(server)), { method: "DELETE", key, signal });
}

/** Where the filters are by which a head hears ambisonic channels: {hrtf, order, sample_rate, delay_samples, filters[ear][channel]}. `base` is the
    address of v1/. */
export function decoderUrl(base, head, { order, sampleRate }) {
  const url = new URL(`hrtfs/${encodeURIComponent(head)}/decoder`, base);
  for (const [name, value] of Object.entries({ order, sample_rate: sampleRate })) url.searchParams.set(name, value);
  return url;
}
