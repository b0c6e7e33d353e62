// The storeys of a scene, and the choice of the one that is drawn. It follows the listener, and who chooses another goes there.

export class Storeys {
  #select;
  #world;
  #storeys;
  #shown;
  #show;

  /** `show(storey)` is called with the storey to draw, {floor_m, top_m}, or null where there are none. */
  constructor(select, world, show) {
    this.#select = select;
    this.#world = world;
    this.#storeys = world.scene.storeys ?? [];
    this.#show = show;
    select.replaceChildren(...this.#storeys.map((_, index) => new Option(nameOf(index), index)));
    select.hidden = this.#storeys.length < 2;
    select.addEventListener("change", () => this.#go(this.#storeys[select.value]));
    world.addEventListener("listener", () => this.#follow());
    this.#follow();
  }

  #of(heightM) {
    return this.#storeys.findLast(({ floor_m: floor }) => floor <= heightM) ?? this.#storeys[0] ?? null;
  }

  #follow() {
    const storey = this.#of(this.#world.listener.position[2]);
    if (storey === this.#shown) return;
    this.#shown = storey;
    if (storey) this.#select.value = this.#storeys.indexOf(storey);
    this.#show(storey);
  }

  /** Takes the listener to a storey, as high above its floor as now. */
  #go(storey) {
    const [x, y, z] = this.#world.listener.position;
    this.#world.moveListener([x, y, storey.floor_m + z - this.#shown.floor_m]);
  }
}

const nameOf = (index) => (index === 0 ? "Ground floor" : `Floor ${index}`);
