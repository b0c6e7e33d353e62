// A situation as a link: in the query the scene, and the sample rate if it was chosen; after the # who stands where, what plays and how it is
// heard.
//
//   ?scene=house#doors=living:0.5,bath:1&listener=…
//   ?scene=apartment#listener=2.2,2,1.6,45&source=guitar,6,3,1.5,-3&source=claps,1,1,1.5&level=…&output=mono&head=kemar&turning=server&effects=hrtf:off
//
// Positions are metres, the listener's last number is its yaw in degrees, a source's is its gain in decibels.

import { GAIN_DB } from "./world.js";

const DIGITS = 3;
const rounded = (value) => +value.toFixed(DIGITS);
const degrees = (radians) => (radians * 180) / Math.PI;

/** The link to a situation, on the page at `href`. What the situation does not have is left to the page. */
export function linkTo(href, { scene, rate, listener, sources, level, output, head, turning, effects, doors }) {
  const said = new URLSearchParams();
  said.append("listener", [...listener.position.map(rounded), rounded(degrees(listener.yaw))].join());
  for (const { clip, position, gainDb } of sources) {
    const numbers = position.map(rounded);
    if (gainDb !== 0) numbers.push(rounded(gainDb));
    said.append("source", [encodeURIComponent(clip), ...numbers].join());
  }
  for (const [name, value] of Object.entries({ level, output, head, turning })) if (value !== undefined) said.append(name, value);
  const switched = Object.entries(effects ?? {}).map(([name, isOn]) => `${name}:${isOn ? "on" : "off"}`);
  if (switched.length > 0) said.append("effects", switched.join());
  const moved = Object.entries(doors ?? {}).map(([name, openness]) => `${encodeURIComponent(name)}:${rounded(openness)}`);
  if (moved.length > 0) said.append("doors", moved.join());
  const link = new URL(href);
  link.search = new URLSearchParams(rate === undefined ? { scene } : { scene, rate });
  // Commas and colons may stand in a fragment, and are easier to read than what they are escaped to.
  link.hash = said.toString().replaceAll("%2C", ",").replaceAll("%3A", ":");
  return link.href;
}

/** Numbers of a text, if there are `count` of them or one more. */
function numbersOf(text, count) {
  const numbers = text.split(",").map((each) => (each.trim() === "" ? NaN : Number(each)));
  return (numbers.length === count || numbers.length === count + 1) && numbers.every(Number.isFinite) ? numbers : null;
}

function listenerOf(text) {
  const numbers = text === null ? null : numbersOf(text, 3);
  return numbers && { position: numbers.slice(0, 3), yaw: ((numbers[3] ?? 0) * Math.PI) / 180 };
}

function sourceOf(text) {
  const comma = text.indexOf(",");
  const numbers = comma < 0 ? null : numbersOf(text.slice(comma + 1), 3);
  if (!numbers) return null;
  const gainDb = Math.min(GAIN_DB.max, Math.max(GAIN_DB.min, numbers[3] ?? 0));
  return { clip: decoded(text.slice(0, comma)), position: numbers.slice(0, 3), gainDb };
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

function effectsOf(text) {
  const pairs = (text ?? "").split(",").map((each) => each.split(":"));
  return Object.fromEntries(pairs.filter(([name, state]) => name && ["on", "off"].includes(state)).map(([name, state]) => [name, state === "on"]));
}

function doorsOf(text) {
  const pairs = (text ?? "").split(",").map((each) => each.split(":"));
  const read = pairs.filter(([name, share]) => name && (share ?? "").trim() !== "" && Number.isFinite(Number(share)));
  return Object.fromEntries(read.map(([name, share]) => [decoded(name), Number(share)]));
}

/** What a link says after its #, or null if it says nothing. Parts that cannot be read are left out. */
export function readSituation(hash) {
  const said = new URLSearchParams(hash.replace(/^#/, ""));
  if (![...said.keys()].length) return null;
  const [level, output, head, turning] = ["level", "output", "head", "turning"].map((name) => said.get(name) ?? undefined);
  return {
    listener: listenerOf(said.get("listener")),
    sources: said.getAll("source").map(sourceOf).filter(Boolean),
    level,
    output,
    head,
    turning,
    effects: effectsOf(said.get("effects")),
    doors: doorsOf(said.get("doors")),
  };
}
