// The interactive part of the floor plan, an SVG over the canvas: the listener with a handle for the heading, and the emitters. Each
// can be dragged by mouse, pen or finger, and focused and moved by keyboard.
// Events: "dropped" (detail: emitter id, after it came to rest), "lifted" (an emitter started to move), "hover" (detail: [x, y] in
// metres or null).

import { Doors, opennessTowards } from "./doors.js";
import { inNextFrame } from "./frames.js";
import { View } from "./paper.js";
import { sourceColour } from "./palette.js";

const SVG = "http://www.w3.org/2000/svg";
const SLOP = 4; // pixels that a click may move
const RIPPLE_MS = 2400; // from an emitter until it is gone
const STILL = matchMedia("(prefers-reduced-motion: reduce)");

function element(name, attributes = {}, ...children) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

function text(content, attributes) {
  const node = element("text", attributes);
  node.textContent = content;
  return node;
}

const degrees = (radians) => (radians * 180) / Math.PI;

export class FloorPlan extends EventTarget {
  #svg;
  #paper;
  #world;
  #view = null;
  #listener;
  #handle;
  #ears;
  #emitterMarks = new Map();
  #emitterLayer = element("g");
  #drag = null;
  #doors;
  #storey = null;

  constructor({ svg, paper, world }) {
    super();
    this.#svg = svg;
    this.#paper = paper;
    this.#world = world;
    this.#listener = this.#buildListener();
    this.#doors = new Doors(world);
    this.#doors.layer.addEventListener("pointerdown", (event) => this.#grab(event));
    svg.replaceChildren(this.#doors.layer, this.#emitterLayer, this.#listener);
    svg.addEventListener("pointermove", (event) => this.#move(event));
    svg.addEventListener("pointerup", (event) => this.#drop(event));
    svg.addEventListener("pointercancel", (event) => this.#drop(event));
    svg.addEventListener("pointerleave", () => this.#emit("hover", null));
    // Scrolling would end a drag.
    const grabbed = (event) => event.target.closest("[data-drag]") && event.preventDefault();
    svg.addEventListener("touchstart", grabbed, { passive: false });
    // What is dragged is at the pointer at once.
    world.addEventListener("listener", () => (this.#drag ? this.#placeListener() : inNextFrame(this.#placeListener)));
    world.addEventListener("emitter", ({ detail }) => (this.#drag ? this.#placeEmitter(detail) : inNextFrame(this.#syncEmitters)));
    world.addEventListener("emitters", () => this.#syncEmitters());
    new ResizeObserver(() => this.#resize()).observe(svg.parentElement);
    this.#resize();
  }

  get focusedEmitter() {
    return document.activeElement?.closest?.("[data-emitter]")?.dataset.emitter ?? null;
  }

  /** Shows the levels at the listener's ears, from 0 to 1. */
  glow(left, right) {
    this.#ears[0].style.setProperty("--level", left.toFixed(2));
    this.#ears[1].style.setProperty("--level", right.toFixed(2));
  }

  /** Shows the two ripples about each emitter as far as they have spread by now. */
  ripple() {
    if (STILL.matches) return;
    const spread = performance.now() / RIPPLE_MS;
    this.#emitterLayer.style.setProperty("--spread", (spread % 1).toFixed(3));
    this.#emitterLayer.style.setProperty("--second-spread", ((spread + 0.5) % 1).toFixed(3));
  }

  #emit(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  #resize() {
    const width = Math.floor(this.#svg.parentElement.clientWidth);
    if (width === 0 || width === this.#view?.width) return;
    const { corners, walls_known: walled } = this.#world.scene;
    this.#view = new View({ corners, walled, width });
    this.#svg.setAttribute("viewBox", `0 0 ${width} ${this.#view.height}`);
    this.#svg.style.height = `${this.#view.height}px`;
    this.#paper.resize(this.#view);
    this.#doors.place(this.#view, this.#storey);
    this.#placeListener();
    this.#syncEmitters();
  }

  /** Shows a storey, {floor_m, top_m}: its doors, and what is on others paler. Null shows all. */
  set storey(storey) {
    this.#storey = storey;
    if (!this.#view) return;
    this.#doors.place(this.#view, storey);
    this.#syncEmitters();
  }

  #buildListener() {
    const ear = (y) => element("ellipse", { class: "ear", cx: -1, cy: y, rx: 5.5, ry: 3.6 });
    this.#ears = [ear(-14), ear(14)];
    this.#handle = element(
      "g",
      { class: "handle", "data-drag": "heading", transform: "translate(54 0)" },
      element("circle", { class: "touch", r: 22 }),
      element("circle", { class: "knob", r: 7.5 }),
    );
    const head = element(
      "g",
      { class: "head", "data-drag": "listener" },
      element("circle", { class: "touch", r: 26 }),
      ...this.#ears,
      element("path", { class: "face", d: "M 19.5 0 L 11.5 -6.5 A 13.5 13.5 0 1 0 11.5 6.5 Z" }),
    );
    const turning = element(
      "g",
      { class: "turning" },
      element("path", { class: "gaze", d: "M 0 0 L 92 -44 A 102 102 0 0 1 92 44 Z", fill: "url(#gaze)" }),
      element("line", { class: "neck", x1: 22, y1: 0, x2: 46, y2: 0 }),
      this.#handle,
      head,
    );
    const stops = [["0.12", 0.3], ["1", 0]].map(([offset, opacity]) =>
      element("stop", { offset, "stop-opacity": opacity, class: "gaze-stop" }),
    );
    const gradient = element("radialGradient", { id: "gaze", gradientUnits: "userSpaceOnUse", cx: 0, cy: 0, r: 102 }, ...stops);
    const group = element(
      "g",
      { class: "listener", tabindex: 0, role: "slider", "aria-label": "Listener", "aria-valuemin": 0, "aria-valuemax": 359 },
      element("defs", {}, gradient),
      element("circle", { class: "focus", r: 30 }),
      turning,
    );
    group.addEventListener("pointerdown", (event) => this.#grab(event));
    return group;
  }

  #buildEmitter(id) {
    const group = element(
      "g",
      { class: "emitter", tabindex: 0, role: "button", "data-emitter": id, "data-drag": "emitter" },
      element("circle", { class: "touch", r: 24 }),
      element("circle", { class: "ripple", r: 21 }),
      element("circle", { class: "ripple second", r: 28 }),
      element("circle", { class: "focus", r: 22 }),
      element("circle", { class: "disc", r: 14 }),
      text(id, { class: "letter", "text-anchor": "middle", dy: "0.36em" }),
    );
    group.style.setProperty("--source", sourceColour(id));
    group.addEventListener("pointerdown", (event) => this.#grab(event));
    return group;
  }

  #syncEmitters = () => {
    const { emitters } = this.#world;
    for (const [id, mark] of this.#emitterMarks) {
      if (emitters.has(id)) continue;
      mark.remove();
      this.#emitterMarks.delete(id);
    }
    for (const [id, emitter] of emitters) {
      if (!this.#emitterMarks.has(id)) {
        const mark = this.#buildEmitter(id);
        this.#emitterMarks.set(id, mark);
        this.#emitterLayer.append(mark);
      }
      this.#placeEmitter(emitter);
    }
  };

  #placeListener = () => {
    const { position, yaw } = this.#world.listener;
    const [x, y] = this.#view.toScreen(position);
    this.#listener.setAttribute("transform", `translate(${x.toFixed(2)} ${y.toFixed(2)})`);
    this.#listener.querySelector(".turning").setAttribute("transform", `rotate(${(-degrees(yaw)).toFixed(2)})`);
    const heading = (Math.round(degrees(yaw)) + 360) % 360;
    this.#listener.setAttribute("aria-valuenow", heading);
    this.#listener.setAttribute("aria-valuetext", `${position[0].toFixed(1)}, ${position[1].toFixed(1)} metres, facing ${heading} degrees`);
  };

  #placeEmitter({ id, position }) {
    const [x, y] = this.#view.toScreen(position);
    const mark = this.#emitterMarks.get(id);
    mark.setAttribute("transform", `translate(${x.toFixed(2)} ${y.toFixed(2)})`);
    const storey = this.#storey;
    mark.classList.toggle("elsewhere", storey !== null && (position[2] < storey.floor_m || position[2] >= storey.top_m));
    mark.setAttribute("aria-label", `Source ${id} at ${position[0].toFixed(1)}, ${position[1].toFixed(1)} metres; arrow keys move it`);
  }

  /** The place [x, y] at a mouse event. */
  at(event) {
    return this.#pointer(event);
  }

  #pointer({ clientX, clientY }) {
    const box = this.#svg.getBoundingClientRect();
    return this.#view.toWorld([clientX - box.left, clientY - box.top]);
  }

  #grab(event) {
    if (event.button !== 0 || this.#drag) return;
    const target = event.target.closest("[data-drag]");
    if (!target) return;
    const kind = target.dataset.drag;
    const at = this.#pointer(event);
    const id = target.dataset.emitter;
    if (kind === "door") {
      const door = this.#world.doors.get(target.dataset.door);
      // Where the place that was grabbed is while the door is shut.
      const from = [0, 1].map((axis) => at[axis] - door.openness * door.slide_m[axis]);
      this.#drag = { kind, door, pointerId: event.pointerId, from, began: at, moved: false };
      this.#svg.setPointerCapture(event.pointerId);
      this.#svg.classList.add("dragging");
      target.focus({ preventScroll: true, focusVisible: false });
      event.preventDefault();
      return;
    }
    const { position } = id ? this.#world.emitters.get(id) : this.#world.listener;
    this.#drag = { kind, id, pointerId: event.pointerId, offset: [position[0] - at[0], position[1] - at[1]], moved: false };
    this.#svg.setPointerCapture(event.pointerId);
    this.#svg.classList.add("dragging");
    // After any drag the keys move the listener. Only Tab gives the keyboard to an emitter.
    this.#listener.focus({ preventScroll: true, focusVisible: false });
    event.preventDefault();
  }

  #move(event) {
    const at = this.#pointer(event);
    const drag = this.#drag;
    if (!drag) {
      this.#emit("hover", event.pointerType === "touch" ? null : at);
      return;
    }
    if (event.pointerId !== drag.pointerId) return;
    if (drag.kind === "door") {
      if (!drag.moved && Math.hypot(at[0] - drag.began[0], at[1] - drag.began[1]) * this.#view.scale < SLOP) return;
      drag.moved = true;
      this.#world.setDoor(drag.door.name, opennessTowards(drag.door, at, drag.from));
      return;
    }
    const to = [at[0] + drag.offset[0], at[1] + drag.offset[1]];
    if (drag.kind === "heading") {
      const { position } = this.#world.listener;
      this.#world.moveListener(null, Math.atan2(at[1] - position[1], at[0] - position[0]));
    } else if (drag.kind === "listener") {
      this.#world.moveListener(to);
    } else {
      if (!drag.moved) this.#emit("lifted", drag.id);
      this.#world.moveEmitter(drag.id, to);
    }
    drag.moved = true;
  }

  #drop(event) {
    const drag = this.#drag;
    if (!drag || event.pointerId !== drag.pointerId) return;
    this.#drag = null;
    this.#svg.classList.remove("dragging");
    if (drag.kind === "emitter" && drag.moved) this.#emit("dropped", drag.id);
    if (drag.kind === "door" && !drag.moved) this.#world.setDoor(drag.door.name, drag.door.openness < 0.5 ? 1 : 0);
  }
}
