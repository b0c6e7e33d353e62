// The legend of the loudness map: one swatch per band, labels in decibels, and a needle at the level of the listener or the mouse.

import { loudnessRamp } from "./palette.js";

const format = (level) => `${level < 0 ? "−" : ""}${Math.abs(Math.round(level))}`;

export class Legend {
  #root;
  #swatches;
  #ticks;
  #needle;
  #needleText;
  #note;
  #scale = null;

  constructor(root) {
    const find = (id) => root.querySelector(`#${id}`);
    this.#root = root;
    this.#swatches = find("swatches");
    this.#ticks = find("ticks");
    this.#needle = find("needle");
    this.#needleText = find("needle-text");
    this.#note = find("legend-note");
  }

  show(scale) {
    this.#scale = scale;
    this.#root.hidden = false;
    const { bottom, top, band: width } = scale;
    const bands = Math.round((top - bottom) / width);
    const ramp = loudnessRamp();
    this.#swatches.replaceChildren(
      ...Array.from({ length: bands }, (_, band) => {
        const swatch = document.createElement("i");
        swatch.style.background = `rgb(${ramp(band / (bands - 1)).join(" ")})`;
        return swatch;
      }),
    );
    this.#ticks.replaceChildren();
    for (let level = bottom; level <= top; level += width) {
      if (level % (2 * width) !== 0) continue;
      const tick = document.createElement("span");
      tick.style.left = `${(100 * (level - bottom)) / (top - bottom)}%`;
      tick.textContent = format(level);
      this.#ticks.append(tick);
    }
  }

  /** Sets the caption: what the map shows, or why there is none. */
  set note(text) {
    this.#note.textContent = text;
  }

  /** Moves the needle to `level` in decibels; `where` names the place it belongs to. */
  point(level, where) {
    this.#needle.hidden = !this.#scale || !Number.isFinite(level);
    if (this.#needle.hidden) return;
    const { bottom, top } = this.#scale;
    const fraction = Math.min(1, Math.max(0, (level - bottom) / (top - bottom)));
    this.#needle.style.left = `${(100 * fraction).toFixed(2)}%`;
    this.#needle.classList.toggle("to-left", fraction > 0.5);
    this.#needleText.textContent = `${where} ${format(level)} dB`;
  }
}
