// What the page asks the server. Whatever fails for a reason that may pass (no network, a server that restarts) is tried again until it
// succeeds; what the server refuses is thrown as a Refusal.

const WAITS_MS = [500, 1000, 2000, 4000, 8000];

export class Refusal extends Error {
  constructor(problem) {
    super(problem.detail ?? "the server refused the request");
    this.code = problem.code ?? "http_error";
  }
}

export class Api {
  #onTrouble;
  #onRecovery;
  #again = () => {};

  /** `onTrouble` is called when the server cannot be reached, `onRecovery` when it can be again. */
  constructor({ onTrouble, onRecovery }) {
    this.#onTrouble = onTrouble;
    this.#onRecovery = onRecovery;
    window.addEventListener("online", () => this.#again());
  }

  about = () => this.#json("v1/test");
  begin = () => this.#json("v1/listeners", { method: "POST" });
  standing = (code) => this.#json(`v1/listeners/${encodeURIComponent(code)}`);
  volume = () => this.#bytes("v1/volume");
  sound = (code, number, slot) => this.#bytes(`v1/listeners/${code}/trials/${number}/sounds/${slot}`);

  answer(code, number, answer) {
    const headers = { "Content-Type": "application/json" };
    return this.#json(`v1/listeners/${code}/trials/${number}/answer`, { method: "POST", headers, body: JSON.stringify(answer) });
  }

  async #json(path, options) {
    return (await this.#request(path, options, (response) => response.json())).value;
  }

  async #bytes(path) {
    return (await this.#request(path, {}, (response) => response.arrayBuffer())).value;
  }

  /** Reading the body is part of the attempt: a connection may break in the middle of it. */
  async #request(path, options, read) {
    for (let attempt = 0; ; attempt++) {
      try {
        const response = await fetch(path, { cache: "no-store", ...options });
        if (response.ok) {
          const value = await read(response);
          if (attempt) this.#onRecovery();
          return { value };
        }
        const problem = await response.json().catch(() => ({}));
        if (response.status < 500 || problem.code === "test_full") throw new Refusal(problem);
      } catch (error) {
        if (error instanceof Refusal) throw error;
      }
      this.#onTrouble();
      await this.#wait(WAITS_MS[Math.min(attempt, WAITS_MS.length - 1)]);
    }
  }

  #wait(ms) {
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, ms);
      this.#again = () => {
        clearTimeout(timer);
        resolve();
      };
    });
  }
}
