// The key that the server may ask for. It is kept for this tab alone (sessionStorage) and leaves it in headers only.

const KEPT_AS = "nafir.key";

let asking = null; // the promise of an answer, while the dialog is open

export const key = () => sessionStorage.getItem(KEPT_AS);

/** Asks for another key than the one that was `refused`. Resolves when there is one; all who ask meanwhile share one dialog. */
export function askForKey(reason, refused = key()) {
  if (key() !== refused) return Promise.resolve(); // another answer came first
  asking ??= ask(reason).finally(() => (asking = null));
  return asking;
}

function ask(reason) {
  const dialog = document.getElementById("key");
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
