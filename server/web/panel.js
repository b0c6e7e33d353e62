// The panel of measurements: ear levels, pose-to-sound latency and its parts, the playout buffer, and the server's statistics.

import { Sparkline } from "./sparkline.js";

const FLOOR_DB = -60;
const PRINT_MS = 100; // interval of figures and strip chart
const decibels = (amplitude) => (amplitude > 0 ? 20 * Math.log10(amplitude) : -Infinity);
const fraction = (level) => Math.min(1, Math.max(0, 1 - level / FLOOR_DB));
const milliseconds = (value) => `${Math.round(value)} ms`;

class Meter {
  #bar;
  #peak;
  #output;
  #peakHold = FLOOR_DB;
  #shown = FLOOR_DB;

  constructor(root) {
    this.#bar = root.querySelector("i");
    this.#peak = root.querySelector("b");
    this.#output = root.querySelector("output");
  }

  /** Rises at once and falls slowly, like a programme meter. */
  hear(rms, peak) {
    const level = Math.max(FLOOR_DB, decibels(rms));
    this.#shown = Math.max(level, this.#shown - 1.2);
    this.#peakHold = Math.max(Math.max(FLOOR_DB, decibels(peak)), this.#peakHold - 0.5);
  }

  /** Returns the bar's length, 0 to 1. */
  draw() {
    this.#bar.style.transform = `scaleX(${fraction(this.#shown).toFixed(4)})`;
    this.#peak.style.transform = `translateX(${(100 * fraction(this.#peakHold)).toFixed(2)}%)`;
    return fraction(this.#shown);
  }

  print() {
    this.#output.textContent = this.#shown <= FLOOR_DB ? "–" : `−${Math.abs(Math.round(this.#shown))}`;
  }

  rest() {
    this.#peakHold = this.#shown = FLOOR_DB;
    this.draw();
    this.print();
  }
}

export class Panel {
  #find;
  #left;
  #right;
  #spark;
  #printed = 0;
  #newest = null; // report and ledgers that are not printed yet
  #dropouts = 0;
  #fillMs = null;
  #turnsHere = false;
  #server = { late: 0, dropped: 0 };

  constructor(document) {
    this.#find = (id) => document.getElementById(id);
    this.#left = new Meter(this.#find("meter-left"));
    this.#right = new Meter(this.#find("meter-right"));
    this.#spark = new Sparkline(this.#find("spark"));
    new ResizeObserver(() => this.#spark.draw()).observe(this.#find("spark"));
  }

  recolour() {
    this.#spark.draw();
  }

  /** Whether turns of the head are heard sooner than steps, and so have a figure of their own. */
  set turnsHere(isHere) {
    this.#turnsHere = isHere;
    this.#find("turn").hidden = this.#find("turn-part").hidden = !isHere;
  }

  /** Whether the sound is rendered in this browser and not on the server. */
  set rendersHere(isHere) {
    this.#find("part-server-name").textContent = isHere ? "This browser" : "Server and network";
  }

  /** Takes a worklet report, to be drawn with the latencies of `ledgers`, {direct, reverberation, turn}, of that time. */
  report(report, ledgers) {
    const at = performance.now();
    const fillMs = 1000 * report.fillS;
    this.#fillMs = this.#fillMs === null ? fillMs : this.#fillMs + 0.1 * (fillMs - this.#fillMs);
    const dropout = report.counters.underruns > this.#dropouts;
    this.#dropouts = report.counters.underruns;
    this.#spark.add({ at, value: fillMs, target: 1000 * report.targetS, dropout });
    this.#left.hear(report.rms[0], report.peak[0]);
    this.#right.hear(report.rms[1], report.peak[1]);
    this.#newest = [report, ledgers];
  }

  /** Draws what the reports said. Returns the lengths of the meters of both ears, 0 to 1. */
  draw() {
    const at = performance.now();
    if (this.#newest !== null && at - this.#printed >= PRINT_MS) {
      this.#print(...this.#newest);
      this.#printed = at;
      this.#newest = null;
    }
    return [this.#left.draw(), this.#right.draw()];
  }

  #print({ targetS, counters, started }, ledgers) {
    const latency = ledgers.direct.summary();
    const reverberation = ledgers.reverberation.summary();
    const turn = ledgers.turn.summary();
    this.#left.print();
    this.#right.print();
    this.#spark.draw();
    this.#find("buffer").textContent = Math.round(this.#fillMs);
    this.#find("buffer-note").textContent = started ? `aims for ${Math.round(1000 * targetS)} ms` : "filling";
    this.#find("dropouts").textContent = counters.underruns;
    this.#find("stretched").textContent = counters.stretches;
    this.#find("late").textContent = Math.max(counters.late, this.#server.late);
    this.#find("skipped").textContent = Math.max(counters.gaps, this.#server.dropped);
    for (const id of ["dropouts", "late", "skipped"]) {
      this.#find(id).classList.toggle("alarm", this.#find(id).textContent !== "0");
    }
    if (latency) this.#printLatency(latency);
    if (turn) {
      this.#find("latency-turn").textContent = Math.round(turn.totalMs);
      this.#find("latency-turn-held").textContent = milliseconds(turn.heldMs);
    }
    if (reverberation) this.#find("latency-reverberation").textContent = milliseconds(reverberation.totalMs);
  }

  #printLatency({ totalMs, worstMs, serverMs, bufferMs, outputMs }) {
    this.#find("latency").textContent = Math.round(totalMs);
    this.#find("latency-note").textContent = `${this.#turnsHere ? "a step, " : ""}95% within ${Math.round(worstMs)} ms`;
    this.#find("part-server").textContent = milliseconds(serverMs);
    this.#find("part-buffer").textContent = milliseconds(bufferMs);
    this.#find("part-device").textContent = milliseconds(outputMs);
    const stack = this.#find("stack");
    for (const [name, value] of [["server", serverMs], ["buffered", bufferMs], ["device", outputMs]]) {
      stack.querySelector(`.${name}`).style.flexGrow = Math.max(0, value).toFixed(1);
    }
  }

  /** Shows the server's status message, which comes once a second. */
  status({ blocks_late: late, blocks_dropped: dropped, ir_ms: ir }) {
    this.#server = { late, dropped };
    if (ir?.p50 != null) this.#find("field-cost").textContent = `${ir.p50.toFixed(1)} ms`;
  }

  rest() {
    this.#newest = null;
    this.#left.rest();
    this.#right.rest();
    this.#fillMs = null;
    this.#spark.clear();
    this.#find("buffer").textContent = "–";
    this.#find("buffer-note").textContent = "";
    for (const id of ["latency", "latency-reverberation", "latency-turn", "latency-turn-held", "field-cost"]) this.#find(id).textContent = "–";
    for (const id of ["part-server", "part-buffer", "part-device"]) this.#find(id).textContent = "–";
    this.#find("latency-note").textContent = "measured while playing";
    for (const part of this.#find("stack").children) part.style.flexGrow = 0;
  }
}
