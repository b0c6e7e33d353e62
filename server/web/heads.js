// The menu of the heads that the server offers. Emits "chosen" with a head's name.

const TITLES = { kemar: "KEMAR" };
const titleOf = (name) => TITLES[name] ?? name;

export class Heads extends EventTarget {
  #choice;
  #isKnown = false;
  #wish = null; // a head that is taken if the server offers it
  #isUsed = true;

  /** `choice` is the menu. */
  constructor(choice) {
    super();
    this.#choice = choice;
    choice.addEventListener("change", () => this.dispatchEvent(new CustomEvent("chosen", { detail: choice.value })));
  }

  /** Name of the chosen head; undefined if the server chooses. */
  get chosen() {
    return this.#isKnown ? this.#choice.value : undefined;
  }

  /** Takes this head as soon as the server turns out to offer it. */
  set wish(name) {
    this.#wish = name;
  }

  /** Offers these heads. The present choice stays if it is among them. */
  show({ default: usual, hrtfs }) {
    const before = this.#wish ?? this.chosen;
    this.#wish = null;
    const options = hrtfs.map((name) => {
      const option = new Option(titleOf(name), name);
      option.title = name;
      return option;
    });
    this.#choice.replaceChildren(...options);
    this.#choice.value = hrtfs.includes(before) ? before : usual;
    this.#isKnown = true;
    this.#enable();
  }

  /** Whether the output is headphones, which need a head. */
  set used(isUsed) {
    this.#isUsed = isUsed;
    this.#enable();
  }

  #enable() {
    this.#choice.disabled = !this.#isKnown || !this.#isUsed;
    this.#choice.title = this.#isUsed ? "" : "One loudspeaker is heard through no head.";
  }
}
