// Pose-to-sound latency: the time from setting a pose on the page until the first sample rendered with it, or with a newer one, leaves
// the sound card. It is measured separately for the direct sound and for the reflected field. All times are epoch milliseconds.

const WINDOW_MS = 4000;
const MOST_PENDING = 2000;
const MOST_TURNS = 60;

export function quantile(values, q) {
  if (values.length === 0) return null;
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.min(sorted.length - 1, Math.floor(q * sorted.length))];
}

/** The time from a turn of the head until its sound, where the browser turns the sound. */
export class TurnLedger {
  #samples = []; // {totalMs, heldMs}

  /** `turns` are those that are heard first `at` that time: {at, heldMs}, the time set and the time until the worklet turned the sound. */
  turned({ at, turns }) {
    this.#samples.push(...turns.map((turn) => ({ totalMs: at - turn.at, heldMs: turn.heldMs })));
    this.#samples.splice(0, this.#samples.length - MOST_TURNS);
  }

  restart() {
    this.#samples = [];
  }

  /** Medians over the last turns, in milliseconds: {totalMs, heldMs}; null if there are none yet. */
  summary() {
    if (this.#samples.length === 0) return null;
    const median = (key) => quantile(this.#samples.map((sample) => sample[key]), 0.5);
    return { totalMs: median("totalMs"), heldMs: median("heldMs") };
  }
}

export class PoseLedger {
  #pending = [];
  #samples = []; // {heardAt, totalMs, bufferMs, outputMs}
  newestPosed = 0;
  newestHeard = -1;

  posed({ poseId, at }) {
    if (poseId === 0) this.#restart();
    this.newestPosed = poseId;
    this.#pending.push({ poseId, at });
    if (this.#pending.length > MOST_PENDING) this.#pending.shift();
  }

  #restart() {
    this.#pending = [];
    this.#samples = [];
    this.newestHeard = -1;
  }

  /** `steady` is false while the buffer is still filling, since the latency is then that of the start-up. */
  heard({ poseId, at, bufferedS, outputS }, steady) {
    this.newestHeard = Math.max(this.newestHeard, poseId);
    while (this.#pending.length > 0 && this.#pending[0].poseId <= poseId) {
      const pose = this.#pending.shift();
      if (!steady) continue;
      this.#samples.push({ heardAt: at, totalMs: at - pose.at, bufferMs: 1000 * bufferedS, outputMs: 1000 * outputS });
    }
    while (this.#samples.length > 0 && this.#samples[0].heardAt < at - WINDOW_MS) this.#samples.shift();
  }

  /** Medians over the last seconds, in milliseconds: {totalMs, worstMs, serverMs, bufferMs, outputMs}; null if there are none yet. */
  summary() {
    if (this.#samples.length === 0) return null;
    const median = (key) => quantile(this.#samples.map((sample) => sample[key]), 0.5);
    const totalMs = median("totalMs");
    const outputMs = Math.min(totalMs, median("outputMs"));
    const bufferMs = Math.min(totalMs - outputMs, median("bufferMs"));
    const worstMs = quantile(this.#samples.map(({ totalMs: total }) => total), 0.95);
    return { totalMs, worstMs, bufferMs, outputMs, serverMs: totalMs - bufferMs - outputMs };
  }
}
