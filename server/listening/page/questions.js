// The three kinds of question: three tones, a choice between two sounds, and ratings. Each draws itself into a card and resolves with the
// answer: {answers, plays, seconds}.

import { Sounds } from "./sounds.js";

const UNRATED = 50;

/** The card of a template, with where the listener stands. */
export function card(name, standing) {
  const node = document.getElementById(name).content.firstElementChild.cloneNode(true);
  const where = node.querySelector(".where");
  if (where) {
    const stage = { screening: "Headphones:", practice: "To practise:", test: "Question" }[standing.stage];
    where.textContent = `${stage} ${standing.done + 1} of ${standing.total}`;
    node.querySelector("progress").value = standing.done / standing.total;
  }
  return node;
}

const labelOf = (slot) => (slot === "reference" ? "Reference" : slot.toUpperCase());

export function askTones(node, standing, player, load) {
  const { slots, onsets_s: onsets, tone_s: toneS } = standing.question;
  const options = radios(node, slots, (slot) => `Tone ${slot}`);
  const sounds = new Sounds(player, {
    onTime: (playing, atS) => {
      slots.forEach((slot, index) => {
        const sounding = playing !== null && atS >= onsets[index] && atS < onsets[index] + toneS;
        options.get(slot).parentElement.classList.toggle("sounding", sounding);
      });
    },
  });
  node.querySelector(".sounds").append(sounds.button("tones", "Three tones", "P"));
  const keys = { p: () => sounds.toggle("tones"), s: () => sounds.stop() };
  for (const slot of slots) keys[slot] = () => choose(options, slot);
  return ask(node, { sounds, load, keys, missing: () => missingChoice(sounds, options), answers: () => chosenOf(options) });
}

export function askChoice(node, standing, player, load) {
  const { sounds: played, slots } = standing.question;
  const sounds = new Sounds(player);
  for (const slot of played) node.querySelector(".sounds").append(sounds.button(slot, labelOf(slot), labelOf(slot)[0]));
  const options = radios(node, slots, labelOf);
  const keys = { s: () => sounds.stop(), ArrowLeft: () => choose(options, slots[0]), ArrowRight: () => choose(options, slots[1]) };
  for (const slot of played) keys[slot[0]] = () => sounds.toggle(slot);
  return ask(node, { sounds, load, keys, missing: () => missingChoice(sounds, options), answers: () => chosenOf(options) });
}

export function askRatings(node, standing, player, load) {
  const { slots } = standing.question;
  const sounds = new Sounds(player, { goesOn: true });
  node.querySelector(".sounds").append(sounds.button("reference", "Reference", "R"));
  const sliders = new Map();
  for (const slot of slots) {
    const row = document.createElement("li");
    const slider = document.createElement("input");
    const output = document.createElement("output");
    Object.assign(slider, { type: "range", min: 0, max: 100, step: 1, value: UNRATED });
    slider.setAttribute("aria-label", `Rating of ${labelOf(slot)}, 0 is bad and 100 is excellent`);
    slider.setAttribute("aria-valuetext", "not rated yet");
    output.textContent = "–";
    slider.addEventListener("input", () => {
      row.classList.add("rated");
      output.textContent = slider.value;
      slider.setAttribute("aria-valuetext", slider.value);
      slider.style.setProperty("--value", `${slider.value}%`);
    });
    slider.style.setProperty("--value", `${UNRATED}%`);
    row.append(sounds.button(slot, labelOf(slot), labelOf(slot)), slider, output);
    node.querySelector(".ratings").append(row);
    sliders.set(slot, { slider, row });
  }
  const keys = { r: () => sounds.toggle("reference"), s: () => sounds.stop() };
  for (const slot of slots) keys[slot] = () => sounds.toggle(slot);
  const missing = () => {
    if (sounds.unheard.length) return `Listen to ${sounds.unheard.join(", ")} first.`;
    const unrated = slots.filter((slot) => !sliders.get(slot).row.classList.contains("rated"));
    return unrated.length ? `Rate ${unrated.map(labelOf).join(", ")} too.` : "";
  };
  const answers = () => Object.fromEntries([...sliders].map(([slot, { slider }]) => [slot, slider.valueAsNumber]));
  return ask(node, { sounds, load, keys, missing, answers });
}

function radios(node, slots, label) {
  const options = new Map();
  for (const slot of slots) {
    const option = document.createElement("label");
    option.className = "option";
    const radio = document.createElement("input");
    Object.assign(radio, { type: "radio", name: "answer", value: slot });
    option.append(radio, label(slot));
    node.querySelector(".options").append(option);
    options.set(slot, radio);
  }
  return options;
}

function choose(options, slot) {
  options.get(slot).checked = true;
  options.get(slot).focus();
}

const isChosen = (options) => [...options.values()].some((radio) => radio.checked);
const chosenOf = (options) => Object.fromEntries([...options].map(([slot, radio]) => [slot, Number(radio.checked)]));

function missingChoice(sounds, options) {
  if (sounds.unheard.length) return `Listen to ${sounds.unheard.join(", ")} first.`;
  return isChosen(options) ? "" : "Choose one. If you cannot tell, guess.";
}

/** Resolves when the form is sent and nothing is missing. */
async function ask(node, { sounds, load, keys, missing, answers }) {
  const shownMs = performance.now();
  const problem = node.querySelector(".problem");
  const pressed = (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const isSlider = event.target.type === "range";
    const isRadio = event.target.type === "radio";
    // Arrows and letters of a slider or radio button are the browser's own, which moves them.
    if (event.key.startsWith("Arrow") && (isSlider || isRadio)) return;
    if (event.key === "Enter" && !(event.target instanceof HTMLButtonElement)) {
      event.preventDefault();
      node.requestSubmit();
    }
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act || event.repeat) return;
    event.preventDefault();
    act();
  };
  document.addEventListener("keydown", pressed);
  for (const done of ["click", "input"]) {
    node.addEventListener(done, () => {
      problem.textContent = "";
    });
  }
  try {
    const sent = new Promise((resolve) => {
      node.addEventListener("submit", (event) => {
        event.preventDefault();
        problem.textContent = missing();
        if (!problem.textContent) resolve();
      });
    });
    await sounds.load(load);
    await sent;
    sounds.stop();
    return { answers: answers(), plays: sounds.plays, seconds: (performance.now() - shownMs) / 1000 };
  } finally {
    document.removeEventListener("keydown", pressed);
    sounds.stop();
  }
}
