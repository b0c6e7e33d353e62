// Short messages. At most one of each kind is visible; it disappears by itself and can be dismissed.

const SHOWN_MS = 7000;

export class Notices {
  #container;
  #shown = new Map(); // kind -> {node, timer}

  constructor(container) {
    this.#container = container;
  }

  show(kind, message, { lasting = false } = {}) {
    this.clear(kind);
    const node = document.createElement("div");
    node.className = "notice";
    const text = document.createElement("p");
    text.textContent = message;
    const close = document.createElement("button");
    close.type = "button";
    close.setAttribute("aria-label", "Dismiss");
    close.textContent = "×";
    close.addEventListener("click", () => this.clear(kind));
    node.append(text, close);
    this.#container.append(node);
    const timer = lasting ? 0 : setTimeout(() => this.clear(kind), SHOWN_MS);
    this.#shown.set(kind, { node, timer });
  }

  clear(kind) {
    const shown = this.#shown.get(kind);
    if (!shown) return;
    clearTimeout(shown.timer);
    shown.node.remove();
    this.#shown.delete(kind);
  }
}
