// The doors of a scene on its floor plan: the leaf of each, which can be dragged, and opened or shut by a click or by keyboard. Openness
// runs from 0, shut, to 1.

const STEP = 0.1; // of an arrow key
const SVG = "http://www.w3.org/2000/svg";

const clamped = (share) => Math.min(1, Math.max(0, share));
const radians = (degrees) => (degrees * Math.PI) / 180;

/** The outline of a leaf at an openness. */
export function leafAt({ kind, pivot, angle_deg: angle, slide_m: slide, footprint }, openness) {
  if (kind === "slide") return footprint.map(([x, y]) => [x + openness * slide[0], y + openness * slide[1]]);
  const [cos, sin] = [Math.cos(radians(openness * angle)), Math.sin(radians(openness * angle))];
  const turned = (x, y) => [pivot[0] + cos * x - sin * y, pivot[1] + sin * x + cos * y];
  return footprint.map(([x, y]) => turned(x - pivot[0], y - pivot[1]));
}

const middleOf = (corners) => [0, 1].map((axis) => corners.reduce((sum, corner) => sum + corner[axis], 0) / corners.length);

/** The openness at which a door's leaf points to, or has slid as far as, a place [x, y] that began at `from`. */
export function opennessTowards(door, place, from) {
  const { kind, pivot, angle_deg: angle, slide_m: slide } = door;
  if (kind === "slide") {
    const length = slide[0] ** 2 + slide[1] ** 2;
    return length === 0 ? 0 : clamped(((place[0] - from[0]) * slide[0] + (place[1] - from[1]) * slide[1]) / length);
  }
  const shut = middleOf(door.footprint);
  const turn = Math.atan2(place[1] - pivot[1], place[0] - pivot[0]) - Math.atan2(shut[1] - pivot[1], shut[0] - pivot[0]);
  // The way round in which the door opens, and no farther beyond shut than beyond open.
  const full = radians(angle);
  const spare = Math.PI - Math.abs(full) / 2;
  const along = Math.sign(full) * turn;
  const turns = along - 2 * Math.PI * Math.floor((along + spare) / (2 * Math.PI));
  return full === 0 ? 0 : clamped(turns / Math.abs(full));
}

export class Doors {
  layer = document.createElementNS(SVG, "g");
  #world;
  #marks = new Map(); // name -> its group
  #view = null;
  #storey = null;

  constructor(world) {
    this.#world = world;
    for (const door of world.doors.values()) {
      const mark = document.createElementNS(SVG, "g");
      const attributes = {
        class: "door", tabindex: 0, role: "slider", "data-drag": "door", "data-door": door.name,
        "aria-label": `Door ${door.name}`, "aria-valuemin": 0, "aria-valuemax": 100,
      };
      for (const [key, value] of Object.entries(attributes)) mark.setAttribute(key, value);
      for (const part of ["touch", "leaf"]) {
        const outline = document.createElementNS(SVG, "polygon");
        outline.setAttribute("class", part);
        mark.append(outline);
      }
      mark.addEventListener("keydown", (event) => this.#key(event, door));
      this.#marks.set(door.name, mark);
      this.layer.append(mark);
    }
    world.addEventListener("door", ({ detail }) => this.#place(detail));
  }

  /** Draws the doors of a storey, all of them if it is null. */
  place(view, storey) {
    this.#view = view;
    this.#storey = storey;
    for (const door of this.#world.doors.values()) this.#place(door);
  }

  #place(door) {
    if (!this.#view) return;
    const mark = this.#marks.get(door.name);
    const storey = this.#storey;
    const middle = (door.bottom_m + door.top_m) / 2;
    mark.toggleAttribute("hidden", storey !== null && (middle < storey.floor_m || middle >= storey.top_m));
    const points = leafAt(door, door.openness).map((corner) => this.#view.toScreen(corner).map((value) => value.toFixed(2)).join());
    for (const outline of mark.children) outline.setAttribute("points", points.join(" "));
    const percent = Math.round(100 * door.openness);
    mark.setAttribute("aria-valuenow", percent);
    mark.setAttribute("aria-valuetext", percent === 0 ? "shut" : percent === 100 ? "open" : `${percent} percent open`);
  }

  #key(event, { name, openness }) {
    const steps = { ArrowUp: STEP, ArrowRight: STEP, ArrowDown: -STEP, ArrowLeft: -STEP };
    const ends = { Home: 0, End: 1, Enter: openness < 0.5 ? 1 : 0, Space: openness < 0.5 ? 1 : 0 };
    const { code } = event;
    if (event.ctrlKey || event.altKey || event.metaKey || !(code in steps || code in ends)) return;
    event.preventDefault();
    event.stopPropagation(); // the keys walk elsewhere
    this.#world.setDoor(name, code in steps ? openness + steps[code] : ends[code]);
  }
}
