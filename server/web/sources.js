// The list of emitters beside the floor plan: clip, gain and direction from the listener of each, with controls to add and remove one.

import { inNextFrame } from "./frames.js";
import { isVisible } from "./geometry.js";
import { sourceColour } from "./palette.js";
import { GAIN_DB } from "./world.js";

const AHEAD = Math.PI / 12;

function describe({ distanceM, bearing }, visible) {
  const degrees = Math.round((Math.abs(bearing) * 180) / Math.PI);
  let direction = `${degrees}° ${bearing > 0 ? "left" : "right"}`;
  if (Math.abs(bearing) < AHEAD) direction = "ahead";
  else if (Math.abs(bearing) > Math.PI - AHEAD) direction = "behind";
  return `${distanceM.toFixed(1)} m, ${direction}${visible ? "" : ", out of sight"}`;
}

/** Disables a control but leaves it focusable, so that a user can find out why. The attribute `disabled` would not. */
const disable = (button, isDisabled) => button.setAttribute("aria-disabled", isDisabled);

export class Sources {
  #world;
  #clips;
  #own = []; // {name, title} of the visitor's own sounds
  #list;
  #add;
  #limit;
  #rows = new Map(); // id -> {row, select, remove, gain, place}

  /** `limit` is the element that says why no source can be added. */
  constructor({ world, clips, list, add, limit }) {
    this.#world = world;
    this.#clips = clips;
    this.#list = list;
    this.#add = add;
    this.#limit = limit;
    add.disabled = false;
    add.onclick = () => {
      if (this.#why()) return;
      const { id } = world.addEmitter({ clip: this.nextClip() });
      this.#rows.get(id).row.scrollIntoView({ block: "nearest" });
    };
    world.addEventListener("emitters", () => this.#sync());
    world.addEventListener("limit", () => this.#sync());
    world.addEventListener("emitter", () => inNextFrame(this.#describe));
    world.addEventListener("listener", () => inNextFrame(this.#tellPlaces));
    list.replaceChildren();
    this.#sync();
  }

  set clips(clips) {
    this.#clips = clips;
    this.#sync();
  }

  /** Takes the sounds of the visitor, which every source may play as well. */
  set own(sounds) {
    this.#own = sounds;
    for (const { select } of this.#rows.values()) this.#offer(select);
    this.#describe();
  }

  #offer(select) {
    const { value } = select;
    select.replaceChildren(...[...this.#clips, ...this.#own].map(({ name, title }) => new Option(title || name, name)));
    select.value = value;
  }

  /** The first clip that no emitter plays yet. */
  nextClip() {
    const played = new Set([...this.#world.emitters.values()].map(({ clip }) => clip));
    return (this.#clips.find(({ name }) => !played.has(name)) ?? this.#clips[0]).name;
  }

  /** The reason why no source can be added; empty if one can. */
  #why() {
    if (this.#clips.length === 0) return "The server has no clip to play.";
    const { isFull, mostEmitters: most } = this.#world;
    return isFull ? `This server plays at most ${most === 1 ? "one source" : `${most} sources`} at once.` : "";
  }

  /** Removes a source and moves the focus to the one that takes its place in the list. */
  #remove(id) {
    const at = [...this.#rows.keys()].indexOf(id);
    this.#world.removeEmitter(id);
    const rows = [...this.#rows.values()];
    (rows[Math.min(at, rows.length - 1)]?.remove ?? this.#add).focus();
  }

  #build(emitter) {
    const row = document.createElement("li");
    row.dataset.source = emitter.id;
    row.style.setProperty("--source", sourceColour(emitter.id));
    const badge = document.createElement("span");
    badge.className = "badge";
    badge.textContent = emitter.id;
    const select = document.createElement("select");
    select.setAttribute("aria-label", `What source ${emitter.id} plays`);
    this.#offer(select);
    select.value = emitter.clip;
    let byPointer = false;
    select.addEventListener("pointerdown", () => (byPointer = true));
    select.addEventListener("keydown", () => (byPointer = false));
    select.addEventListener("change", () => {
      this.#world.setClip(emitter.id, select.value);
      if (byPointer) select.blur(); // so that the keys move the listener again
    });
    const remove = document.createElement("button");
    remove.type = "button";
    remove.className = "remove";
    remove.textContent = "×";
    remove.setAttribute("aria-label", `Remove source ${emitter.id}`);
    remove.addEventListener("click", () => this.#world.emitters.size > 1 && this.#remove(emitter.id));
    const gain = document.createElement("input");
    Object.assign(gain, { type: "range", className: "gain", step: 1, ...GAIN_DB, value: emitter.gainDb });
    gain.setAttribute("aria-label", `Gain of source ${emitter.id}, decibels`);
    gain.addEventListener("input", () => this.#world.setGain(emitter.id, gain.valueAsNumber));
    const place = document.createElement("span");
    place.className = "place quiet";
    row.append(badge, select, remove, place, gain);
    this.#list.append(row);
    return { row, select, remove, gain, place };
  }

  #sync() {
    const { emitters } = this.#world;
    for (const [id, { row }] of this.#rows) {
      if (emitters.has(id)) continue;
      row.remove();
      this.#rows.delete(id);
    }
    for (const emitter of emitters.values()) {
      if (!this.#rows.has(emitter.id)) this.#rows.set(emitter.id, this.#build(emitter));
    }
    for (const [id, { remove }] of this.#rows) {
      disable(remove, emitters.size < 2);
      remove.title = emitters.size < 2 ? "The last source stays." : `Remove source ${id}`;
    }
    this.#limit.textContent = this.#why();
    disable(this.#add, this.#limit.textContent !== "");
    this.#describe();
  }

  /** Says where each emitter is from the listener. */
  #tellPlaces = () => {
    const { listener, emitters, scene } = this.#world;
    for (const [id, { place }] of this.#rows) {
      const emitter = emitters.get(id);
      if (!emitter) continue;
      const text = describe(this.#world.bearing(emitter), isVisible(scene.corners, listener.position, emitter.position));
      if (place.textContent !== text) place.textContent = text; // even the same text costs a layout
    }
  };

  #describe = () => {
    this.#tellPlaces();
    const { emitters } = this.#world;
    for (const [id, { select, gain }] of this.#rows) {
      const emitter = emitters.get(id);
      if (!emitter) continue;
      select.value = emitter.clip;
      gain.value = emitter.gainDb;
      gain.title = `${emitter.gainDb > 0 ? "+" : ""}${emitter.gainDb} dB`;
      gain.style.setProperty("--value", `${(100 * (emitter.gainDb - GAIN_DB.min)) / (GAIN_DB.max - GAIN_DB.min)}%`);
      const clip = this.#clips.find(({ name }) => name === emitter.clip);
      select.title = [clip?.title, clip?.credit].filter(Boolean).join(". ");
    }
  };
}
