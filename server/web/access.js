// The key that the server may ask for. The browser asks its user for it and sends it by itself (HTTP Basic), which no page sees. Where
// that is not enough, pages ask for one by the same dialog, which is made when the first needs it. That key is kept for its tab alone
// (sessionStorage), leaves it in headers only, and comes before the browser's.

import { fetchJson } from "./nafir/http.js";

const KEPT_AS = "nafir.key";
const NEEDS_KEY = 401;
const NEEDS_ANOTHER = "scope_missing";
const DIALOG = `
  <form id="key-form">
    <h2 id="key-title">This server asks for a key</h2>
    <p id="key-reason" class="quiet" role="alert"></p>
    <label for="key-field">Key or token</label>
    <input id="key-field" type="password" autocomplete="off" spellcheck="false" required />
    <p class="quiet">It is kept until you close this tab.</p>
    <button class="add" type="submit">Use this key</button>
  </form>`;

let asking = null; // the promise of an answer, while the dialog is open

export const key = () => sessionStorage.getItem(KEPT_AS);

/** What the server says at `url`, asked with the key; with another if it refuses this one, and, if the page can do nothing without what is
    `needed`, if this one is for something else. */
export async function getJson(url, { needed = false, ...options } = {}) {
  const given = key();
  try {
    return await fetchJson(url, { ...options, key: given });
  } catch (error) {
    if (error.status !== NEEDS_KEY && !(needed && error.code === NEEDS_ANOTHER)) throw error;
    await askForKey(error.message, given);
    return getJson(url, { needed, ...options });
  }
}

/** Asks for another key than the one that was `refused`. Resolves when there is one; all who ask meanwhile share one dialog. */
export function askForKey(reason, refused = key()) {
  if (key() !== refused) return Promise.resolve(); // another answer came first
  asking ??= ask(reason).finally(() => (asking = null));
  return asking;
}

function ask(reason) {
  const dialog = document.getElementById("key") ?? makeDialog();
  const field = document.getElementById("key-field");
  document.getElementById("key-reason").textContent = reason;
  field.value = "";
  return new Promise((resolve) => {
    dialog.oncancel = (event) => event.preventDefault(); // there is nothing behind it without a key
    dialog.onclose = () => dialog.showModal();
    document.getElementById("key-form").onsubmit = (event) => {
      event.preventDefault();
      const given = field.value.trim();
      if (!given) return;
      sessionStorage.setItem(KEPT_AS, given);
      field.value = "";
      dialog.onclose = null;
      dialog.close();
      resolve();
    };
    dialog.showModal();
  });
}

function makeDialog() {
  const dialog = document.createElement("dialog");
  dialog.id = "key";
  dialog.className = "asks";
  dialog.setAttribute("aria-labelledby", "key-title");
  dialog.setAttribute("aria-describedby", "key-reason");
  dialog.innerHTML = DIALOG;
  document.body.append(dialog);
  return dialog;
}
