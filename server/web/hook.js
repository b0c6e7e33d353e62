// window.nafir: an interface to the page for tests and for the browser's console.
//
//   await nafir.ready                         the scene is on the page and play can be pressed
//   nafir.state()                             {connection, playing, sampleRate, output, level, head, effects, listener, emitters, doors,
//                                              latency, reverberationLatency, turnLatency, poses}
//   await nafir.setListener({x, y, z, yaw})   metres and radians, each optional; resolves when it is heard (at once while paused)
//   await nafir.setEmitter("A", {x, y, z})    likewise
//   await nafir.capture(seconds)              {sampleRate, left, right}: the last seconds played (12 at most), before the volume

const HEARD_TIMEOUT_MS = 5000;
const POLL_MS = 10;

export function exposeHook(page) {
  let becomeReady;
  const ready = new Promise((resolve) => {
    becomeReady = resolve;
  });

  async function heard(posedBefore) {
    if (!page.playing) return;
    const deadline = performance.now() + HEARD_TIMEOUT_MS;
    // The worker sends the pose a moment after it is set; wait for its id and then for the sound.
    while (page.ledger.newestPosed <= posedBefore || page.ledger.newestHeard <= posedBefore) {
      if (performance.now() > deadline) throw new Error(`pose ${posedBefore + 1} was not heard within ${HEARD_TIMEOUT_MS} ms`);
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    }
  }

  function merged(position, { x = position[0], y = position[1], z = position[2] }) {
    return [x, y, z];
  }

  window.nafir = {
    ready,
    state: () => ({
      connection: page.connection,
      playing: page.playing,
      sampleRate: page.player.sampleRate,
      output: page.output,
      level: page.level,
      head: page.head,
      effects: structuredClone(page.rendered),
      listener: structuredClone(page.world.listener),
      emitters: structuredClone([...page.world.emitters.values()]),
      doors: page.world.openness,
      latency: page.ledger.summary(),
      reverberationLatency: page.reverberationLedger.summary(),
      turnLatency: page.turnLedger.summary(),
      poses: { posed: page.ledger.newestPosed, heard: page.ledger.newestHeard, answered: page.reverberationLedger.newestHeard },
    }),
    setListener(pose) {
      const posed = page.ledger.newestPosed;
      page.world.moveListener(merged(page.world.listener.position, pose), pose.yaw);
      return heard(posed);
    },
    setEmitter(id, place) {
      const posed = page.ledger.newestPosed;
      page.world.moveEmitter(id, merged(page.world.emitters.get(id).position, place));
      page.map();
      return heard(posed);
    },
    capture: (seconds) => page.player.capture(seconds),
  };
  return becomeReady;
}
