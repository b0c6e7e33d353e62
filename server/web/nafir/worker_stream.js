// A Stream in a worker of its own, seen from the page. Its events are the callbacks of Stream: "state", "posed", "status", "level",
// "effects", "refused", "clock", "ended", "joined" and "left", each with its detail, and "failed" (detail: a message) if the worker could not be loaded.

export class WorkerStream extends EventTarget {
  #worker;

  /** `worker` is another Worker of stream_worker.js, where the usual place is not the right one. */
  constructor(worker = new Worker(new URL("./stream_worker.js", import.meta.url), { type: "module" })) {
    super();
    this.#worker = worker;
    this.#worker.onmessage = ({ data: { type, detail } }) => this.dispatchEvent(new CustomEvent(type, { detail }));
    this.#worker.onerror = (event) => {
      this.dispatchEvent(new CustomEvent("failed", { detail: event.message || "The stream could not be started." }));
    };
  }

  /** Opens a stream, in place of any before. `port` is an output's, which gets the blocks. */
  open({ port, ...stream }) {
    this.tell("open", { ...stream, port }, [port]);
  }

  /** Gives the stream a command of stream_worker.js. */
  tell(type, detail, transfer = []) {
    this.#worker.postMessage({ type, detail }, transfer);
  }

  /** Closes the stream, and ends the worker when that is done. */
  end() {
    this.addEventListener("state", ({ detail }) => detail.state === "closed" && this.#worker.terminate());
    this.tell("close");
  }
}
