// The sounds of one question: a button each, how often each was played, and whether each was heard for long enough.

const ICON = `<svg viewBox="0 0 24 24" aria-hidden="true">
  <path class="go" d="M8 5.2v13.6a.6.6 0 0 0 .92.5l10.4-6.8a.6.6 0 0 0 0-1L8.92 4.7A.6.6 0 0 0 8 5.2z" />
  <path class="hold" d="M6.5 6.5h11v11h-11z" />
</svg>`;
const HEARD_S = 1;

export class Sounds {
  #player;
  #goesOn;
  #buttons = new Map(); // slot -> button
  #buffers = new Map();
  #plays = {};
  #heardS = {};
  #frame = 0;
  #onTime;

  /** With `goesOn` the sounds repeat, and another goes on from where the last one is. `onTime(slot, seconds)` follows what is played. */
  constructor(player, { goesOn = false, onTime = () => {} } = {}) {
    this.#player = player;
    this.#goesOn = goesOn;
    this.#onTime = onTime;
  }

  /** A button that plays a slot, and stops it. It is disabled until the sound is there. */
  button(slot, label, key) {
    const button = document.createElement("button");
    button.type = "button";
    button.className = slot === "reference" ? "sound reference" : "sound";
    button.dataset.slot = slot;
    button.disabled = true;
    button.setAttribute("aria-pressed", "false");
    button.setAttribute("aria-label", `Play ${label}`);
    button.setAttribute("aria-keyshortcuts", key);
    button.innerHTML = `${ICON}<span aria-hidden="true"></span><kbd aria-hidden="true"></kbd><i aria-hidden="true"></i>`;
    button.querySelector("span").textContent = label;
    button.querySelector("kbd").textContent = key;
    button.addEventListener("click", () => this.toggle(slot));
    this.#buttons.set(slot, button);
    this.#plays[slot] = 0;
    this.#heardS[slot] = 0;
    return button;
  }

  /** Loads all sounds; `load(slot)` resolves with the bytes of a WAV file. */
  async load(load) {
    const slots = [...this.#buttons.keys()];
    await Promise.all(slots.map(async (slot) => this.#buffers.set(slot, await this.#player.decode(await load(slot)))));
    for (const button of this.#buttons.values()) button.disabled = false;
  }

  get plays() {
    return { ...this.#plays };
  }

  /** Labels of the sounds that were not heard yet. */
  get unheard() {
    return [...this.#buttons].filter(([slot]) => !this.#isHeard(slot)).map(([, button]) => button.querySelector("span").textContent);
  }

  async toggle(slot) {
    if (!this.#buffers.has(slot)) return;
    if (this.#player.slot === slot) {
      this.stop();
      return;
    }
    await this.#player.wake();
    const offsetS = this.#goesOn ? this.#player.positionS : 0;
    this.#settle();
    this.#player.play(slot, this.#buffers.get(slot), { loop: this.#goesOn, offsetS, onEnd: () => this.#ended(slot) });
    this.#plays[slot] += 1;
    this.#draw();
  }

  stop() {
    this.#settle();
    this.#player.stop();
    this.#draw();
  }

  #isHeard(slot) {
    return this.#heardS[slot] + (this.#player.slot === slot ? this.#player.elapsedS : 0) >= HEARD_S;
  }

  /** Adds what was heard of the sound that plays now. */
  #settle() {
    const slot = this.#player.slot;
    if (slot in this.#heardS) this.#heardS[slot] += this.#player.elapsedS;
  }

  #ended(slot) {
    this.#heardS[slot] = Math.max(this.#heardS[slot], HEARD_S);
    this.#draw();
  }

  #draw() {
    cancelAnimationFrame(this.#frame);
    const playing = this.#player.slot;
    for (const [slot, button] of this.#buttons) {
      const share = slot === playing ? this.#player.positionS / this.#buffers.get(slot).duration : 0;
      button.setAttribute("aria-pressed", String(slot === playing));
      button.classList.toggle("heard", this.#isHeard(slot));
      button.querySelector("i").style.transform = slot === playing ? `scaleX(${share})` : "";
    }
    this.#onTime(playing, playing === null ? 0 : this.#player.positionS);
    if (playing !== null) this.#frame = requestAnimationFrame(() => this.#draw());
  }
}
