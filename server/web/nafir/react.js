// Hooks for React 18 and newer.
//
//   const { nafir, state, error, start, stop } = useNafir("https://sound.example", { scene: "apartment" });
//   useEmitter(nafir, { clip: "woman-reading", position: [x, y, 1.5] });
//   return <button onClick={start}>{state}</button>;

import { useCallback, useEffect, useRef, useState } from "react";

import { connect } from "./index.js";

/**
 * A stream that begins with `start`, which has to be called by a click or a key: browsers allow sound only then. `nafir` is what `connect`
 * gives, connected to the loudspeakers; null before and after. `state` is idle, connecting, live, waiting, refused or closed. The stream
 * ends with `stop` and with the component. Options are those of `connect`, as they are when it starts, and `context`, an AudioContext of
 * yours, which is left open.
 */
export function useNafir(url, options) {
  const [nafir, setNafir] = useState(null);
  const [state, setState] = useState("idle");
  const [error, setError] = useState(null);
  const running = useRef(null); // {ending, context, isOwn, nafir}
  const latest = useRef({ url, options });
  latest.current = { url, options };

  const stop = useCallback(() => {
    const ended = running.current;
    running.current = null;
    if (!ended) return;
    ended.ending.abort();
    ended.nafir?.close();
    if (ended.isOwn) ended.context.close();
    setNafir(null);
    setState("closed");
  }, []);

  const start = useCallback(async () => {
    if (running.current) return;
    const { url: address, options: { context: given, ...rest } } = latest.current;
    const context = given ?? new AudioContext({ latencyHint: "interactive" });
    const run = { ending: new AbortController(), context, isOwn: !given, nafir: null };
    running.current = run;
    setError(null);
    setState("connecting");
    try {
      context.resume(); // while the click still counts
      const opened = await connect(context, address, { ...rest, signal: run.ending.signal });
      if (running.current !== run) {
        opened.close();
        return;
      }
      run.nafir = opened;
      opened.output.connect(context.destination);
      opened.addEventListener("state", ({ detail }) => running.current === run && setState(detail.state));
      setNafir(opened);
      setState(opened.state);
    } catch (failure) {
      if (running.current !== run) return; // stopped meanwhile
      stop();
      setError(failure);
      setState("refused");
    }
  }, [stop]);

  useEffect(() => stop, [stop]);
  return { nafir, state, error, start, stop };
}

/** An emitter of a stream, as long as the component is there. Options are those of `addEmitter`; position, direction and gain may change
    with every render, and the sound with another clip. Returns the emitter, or null. */
export function useEmitter(nafir, { position, orientation, yaw, gainDb = 0, clip, source, ...fixed }) {
  const [emitter, setEmitter] = useState(null);
  const first = useRef();
  first.current = { position, gainDb, clip, source, ...fixed, ...(orientation ? { orientation } : { yaw }) };

  useEffect(() => {
    if (!nafir) return undefined;
    const added = nafir.addEmitter(first.current);
    setEmitter(added);
    return () => {
      added.remove();
      setEmitter(null);
    };
  }, [nafir, clip, source]);

  const pose = JSON.stringify([position, orientation, yaw]);
  useEffect(() => {
    emitter?.move({ position, ...(orientation ? { orientation } : yaw === undefined ? {} : { yaw }) });
  }, [emitter, pose]);
  useEffect(() => {
    if (emitter && emitter.gainDb !== gainDb) emitter.gainDb = gainDb;
  }, [emitter, gainDb]);
  return emitter;
}
