// Two ways to hear the same, one key apart: quality levels, or the direct sound alone. Emits "heard" with {level, isDry} and "left".

import { takesKey } from "./walking.js";

const KEY = "KeyX";
const DRY = "dry"; // no level has this name: those of bundles have a rank or a field in it
const DRY_TITLE = "Direct sound alone";

export class Comparison extends EventTarget {
  #choices; // {a, b}: menus
  #button;
  #stop;
  #note;
  #heard = null; // "a", "b" or null while nothing is compared

  /** `root` is the part of the page with the menus, the button that switches and the one that ends the comparison. */
  constructor(root) {
    super();
    const find = (id) => root.querySelector(`#${id}`);
    this.#choices = { a: find("compare-a"), b: find("compare-b") };
    this.#button = find("compare-switch");
    this.#stop = find("compare-stop");
    this.#note = find("compare-heard");
    this.#button.addEventListener("click", () => this.#switch());
    this.#stop.addEventListener("click", () => this.leave());
    for (const [side, choice] of Object.entries(this.#choices)) choice.addEventListener("change", () => this.#heard === side && this.#hear(side));
    window.addEventListener("keydown", (event) => {
      const isPlain = !event.ctrlKey && !event.altKey && !event.metaKey && !event.repeat;
      if (event.code === KEY && isPlain && !takesKey(event) && !this.#button.disabled) this.#switch();
    });
  }

  /** Offers these levels, best first, each {name, title}. What is chosen stays if it is among them. */
  show(levels) {
    const usual = { a: levels[0]?.name, b: DRY };
    for (const [side, choice] of Object.entries(this.#choices)) {
      const before = choice.value;
      choice.replaceChildren(...levels.map(({ name, title }) => new Option(title, name)), new Option(DRY_TITLE, DRY));
      choice.value = [...choice.options].some(({ value }) => value === before) ? before : usual[side];
      choice.disabled = levels.length === 0;
    }
    this.#button.disabled = levels.length === 0;
  }

  /** Ends the comparison, if there is one. */
  leave() {
    if (this.#heard === null) return;
    this.#heard = null;
    this.#describe();
    this.dispatchEvent(new Event("left"));
  }

  #switch() {
    this.#hear(this.#heard === "a" ? "b" : "a");
  }

  #hear(side) {
    this.#heard = side;
    const { value } = this.#choices[side];
    this.#describe();
    // The direct sound does not depend on the level, so that stays as it is.
    this.dispatchEvent(new CustomEvent("heard", { detail: value === DRY ? { level: null, isDry: true } : { level: value, isDry: false } }));
  }

  #describe() {
    const next = this.#heard === "a" ? "B" : "A";
    this.#button.textContent = this.#heard === null ? "Hear A" : `Switch to ${next}`;
    this.#stop.hidden = this.#heard === null;
    this.#note.textContent = this.#heard === null ? "" : `You hear ${this.#heard.toUpperCase()}.`;
    for (const [side, choice] of Object.entries(this.#choices)) choice.closest("label").classList.toggle("heard", side === this.#heard);
  }
}
