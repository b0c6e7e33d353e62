// The menu of where sound is turned when the head turns: in the browser, which then gets ambisonic sound, or on the server, which then
// sends the sound of two ears. Emits "chosen".

const NO_DIRECTIONS = "This scene knows what two ears hear, and not from where sound arrives.";
const LEVEL_WITHOUT = "This quality level knows what two ears hear, and not from where sound arrives.";
const RENDERED_HERE = "What is rendered in this browser is turned in it.";
const NO_HEAD = "One loudspeaker is the same wherever the head looks.";

export class Turning extends EventTarget {
  #choice;
  #wish = "browser";
  #isChosen = false;
  #levels = []; // of the scene, those that know directions
  #level = "auto";
  #isUsed = true;
  #isRenderedHere = false;

  /** `choice` is the menu. */
  constructor(choice) {
    super();
    this.#choice = choice;
    this.#wish = choice.value;
    choice.addEventListener("change", () => {
      this.#wish = choice.value;
      this.#isChosen = true;
      this.dispatchEvent(new Event("chosen"));
    });
  }

  /** Whether a level of the scene knows from where sound arrives. */
  get isPossible() {
    return this.#levels.length > 0;
  }

  /** Whether the browser is to turn the sound. */
  get isHere() {
    return this.#isRenderedHere || (this.#choice.value === "browser" && this.#isUsed);
  }

  /** Whether the browser is to turn the sound of a quality level. */
  turns(level) {
    return this.isPossible && (level === "auto" || this.#levels.includes(level)) && this.#wish === "browser";
  }

  /** What was chosen: "browser" or "server"; undefined if nothing was. */
  get chosen() {
    return this.#isChosen ? this.#wish : undefined;
  }

  /** Chooses as if by the menu. Anything but "browser" and "server" is ignored. */
  set chosen(where) {
    if (!["browser", "server"].includes(where)) return;
    this.#wish = where;
    this.#isChosen = true;
    this.#show();
  }

  /** Where sound is turned until someone chooses: "browser" or "server". */
  set usual(where) {
    if (!this.#isChosen) this.#wish = where;
    this.#show();
  }

  /** Takes the names of the levels that know from where sound arrives. */
  set directionalLevels(names) {
    this.#levels = names;
    this.#show();
  }

  /** The chosen quality level. */
  set level(name) {
    this.#level = name;
    this.#show();
  }

  /** Whether the sound is rendered in this browser and not on the server. */
  set rendersHere(isHere) {
    this.#isRenderedHere = isHere;
    this.#show();
  }

  /** Whether the output is headphones. */
  set used(isUsed) {
    this.#isUsed = isUsed;
    this.#show();
  }

  /** Leaves it to the server, because the browser cannot. */
  giveUp() {
    this.#wish = "server";
    this.#show();
  }

  #show() {
    if (this.#isRenderedHere) {
      this.#choice.disabled = true;
      this.#choice.value = "browser";
      this.#choice.title = RENDERED_HERE;
      return;
    }
    const { isPossible } = this;
    const isOfLevel = this.#level === "auto" || this.#levels.includes(this.#level);
    this.#choice.disabled = !isPossible || !isOfLevel || !this.#isUsed;
    this.#choice.value = this.turns(this.#level) ? "browser" : "server";
    this.#choice.title = !isPossible ? NO_DIRECTIONS : !isOfLevel ? LEVEL_WITHOUT : !this.#isUsed ? NO_HEAD : "";
  }
}
