// The course of a listening test: welcome, volume, tones, practice, questions, thanks. The server knows where a listener stands; the page
// asks it after every answer, so that it can be closed at any time.

import { Api, Refusal } from "./api.js";
import { Notices } from "./notices.js";
import { Player } from "./player.js";
import { askChoice, askRatings, askTones, card } from "./questions.js";

const STORED = "nafir-listening-test";

const stage = document.getElementById("stage");
const notices = new Notices(document.getElementById("notices"));
const player = new Player();
const api = new Api({
  onTrouble: () => {
    connect("waiting", "Waiting for the server");
    notices.show("network", "The server cannot be reached. Nothing is lost: the page tries again until it answers.", { lasting: true });
  },
  onRecovery: () => {
    connect("live", "Connected");
    notices.clear("network");
  },
});

function connect(state, text) {
  document.getElementById("connection").dataset.state = state;
  document.getElementById("connection-text").textContent = text;
}

// A browser may forbid storage. Then the code has to be typed in.
const stored = {
  get: () => attempt(() => localStorage.getItem(STORED)),
  set: (code) => attempt(() => localStorage.setItem(STORED, code)),
  clear: () => attempt(() => localStorage.removeItem(STORED)),
};

function attempt(action) {
  try {
    return action();
  } catch {
    return null;
  }
}

/** Shows a card. Its heading gets the focus, so that screen readers read it. */
function show(view, node) {
  stage.dataset.view = view;
  stage.replaceChildren(node);
  node.querySelector("h2").focus({ preventScroll: true });
  window.scrollTo(0, 0);
}

function plural(count, one, many) {
  return `${count} ${count === 1 ? one : many}`;
}

function welcome(about) {
  const node = card("start");
  const isChoice = about.kind === "choice";
  node.querySelector("h2").textContent = isChoice ? "Which sounds nearer?" : "How alike do they sound?";
  node.querySelector(".lead").textContent = isChoice
    ? "You hear music in a room, and two attempts to make it sound as if it were there. Say which of the two is nearer."
    : "You hear music in a room, and attempts to make it sound as if it were there. Say how alike each of them is.";
  const steps = [
    about.screening ? "Headphones: six times, three tones" : "Headphones and volume",
    plural(about.practice, "question to practise", "questions to practise"),
    plural(about.questions, "question", "questions") + ` about sounds of ${about.sound_s.toFixed(0)} seconds`,
  ];
  for (const text of steps) {
    const step = document.createElement("li");
    step.textContent = text;
    node.querySelector(".steps").append(step);
  }
  return new Promise((resolve) => {
    const begin = node.querySelector("#begin");
    begin.addEventListener("click", () => {
      begin.setAttribute("aria-disabled", "true");
      resolve(begun());
    });
    const resume = node.querySelector("#resume");
    if (stored.get()) {
      resume.hidden = false;
      resume.textContent = `Go on as ${stored.get()}`;
      resume.addEventListener("click", () => resolve(known(stored.get())));
    }
    node.querySelector("#with-code").addEventListener("submit", async (event) => {
      event.preventDefault();
      const standing = await known(node.querySelector("#code").value.trim().toLowerCase());
      if (standing) resolve(standing);
      else node.querySelector("#with-code .problem").textContent = "Nobody has begun with this code. Check it, or begin anew.";
    });
    show("start", node);
  });
}

async function begun() {
  const standing = await api.begin();
  stored.set(standing.code);
  return standing;
}

/** Where a listener stands; null if nobody has this code. */
async function known(code) {
  try {
    const standing = await api.standing(code);
    stored.set(code);
    return standing;
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    if (stored.get() === code) stored.clear();
    return null;
  }
}

async function volume() {
  const node = card("volume");
  const button = node.querySelector(".play");
  const set = new Promise((resolve) => {
    node.querySelector("#set").addEventListener("click", resolve);
  });
  show("volume", node);
  const buffer = player.decode(await api.volume());
  button.disabled = false;
  button.addEventListener("click", async () => {
    await player.wake();
    const isPlaying = player.slot !== null;
    if (isPlaying) player.stop();
    else player.play("volume", await buffer, { loop: true });
    button.setAttribute("aria-pressed", String(!isPlaying));
    button.querySelector("span").textContent = isPlaying ? "Play the music" : "Stop the music";
  });
  await set;
  await player.wake();
  player.stop();
}

/** Asks one question and returns where the listener stands then. */
async function question(about, standing) {
  const { number } = standing.question;
  const kind = standing.stage === "screening" ? "screening" : about.kind;
  const ask = { screening: askTones, choice: askChoice, rating: askRatings }[kind];
  const node = card(kind, standing);
  const answered = ask(node, standing, player, (slot) => api.sound(standing.code, number, slot));
  if (standing.stage === "screening" && standing.tries === 2 && standing.done === 0) {
    notices.show("again", "That was not as expected from headphones. Check that they are connected; you may try once more.", { lasting: true });
  }
  stage.dataset.trial = number;
  show(kind, node);
  const answer = await answered;
  notices.clear("again");
  const send = node.querySelector("[type=submit]");
  send.setAttribute("aria-disabled", "true");
  const next = await api.answer(standing.code, number, answer);
  if (next.nearest) await tell(node, next.nearest, answer.answers[next.nearest] === 1);
  return next;
}

/** After practice: which one was the reference itself. */
function tell(node, nearest, isRight) {
  const name = nearest.toUpperCase();
  node.querySelector(".told").textContent = isRight
    ? `Right: ${name} was the reference itself.`
    : `It was ${name}, which was the reference itself. Listen again if you like.`;
  const send = node.querySelector("[type=submit]");
  send.setAttribute("aria-disabled", "false");
  send.focus();
  return new Promise((resolve) => {
    node.addEventListener("submit", (event) => {
      event.preventDefault();
      resolve();
    });
  });
}

function end(standing) {
  const node = card("end");
  const isDone = standing.stage === "done";
  node.querySelector("h2").textContent = isDone ? "Thank you" : "Thank you for trying";
  node.querySelector(".lead").textContent = isDone
    ? "That was all. Your answers are stored; you may close this page."
    : "This test needs headphones, and your answers to the tones sound like loudspeakers. Somebody with headphones may begin anew.";
  node.querySelector("code").textContent = standing.code;
  stored.clear();
  show("end", node);
  return new Promise((resolve) => {
    node.querySelector("#again").addEventListener("click", resolve);
  });
}

function showCode(code) {
  const footnote = document.getElementById("footnote");
  footnote.querySelector("code").textContent = code;
  footnote.hidden = !code;
}

async function course(about) {
  let standing = null;
  while (!standing) standing = await welcome(about);
  if (standing.question) showCode(standing.code);
  if (standing.question) await volume();
  while (standing.question) {
    try {
      standing = await question(about, standing);
    } catch (error) {
      if (!(error instanceof Refusal)) throw error;
      // Another window answered, or this answer had arrived before the connection broke.
      notices.show("refused", "The test went on elsewhere. Here is the next question.");
      standing = await api.standing(standing.code);
    }
  }
  showCode("");
  await end(standing);
}

const about = await api.about();
document.getElementById("scene-name").textContent = `Listening test: ${about.name}`;
connect("live", "Connected");
for (;;) {
  try {
    await course(about);
  } catch (error) {
    notices.show("refused", error instanceof Refusal ? `${error.message}.` : `Something failed: ${error.message}. Your answers are stored.`);
  }
}
