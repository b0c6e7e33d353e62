// Hooks for React 18 and newer.
//
//   const { nafir, state, error, start, stop } = useNafir("https://sound.example", { scene: "apartment" });
//   useEmitter(nafir, { clip: "woman-reading", position: [x, y, 1.5] });
//   return <button onClick={start}>{state}</button>;

import { useCallback, useEffect, useRef, useState } from "react";

import { RefusedError, connect } from "./index.js";

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

/** A listener beside the first, as long as the component is there. Options are those of `addListener`; position and direction may change with
    every render, and with another id or head it is another listener. Returns `listener`, which is null before it is there and when it is gone,
    and `error`, which says why it is not there, or is null. */
export function useListener(nafir, { position, orientation, yaw, ...fixed } = {}) {
  const [there, setThere] = useState({ listener: null, error: null });
  const first = useRef();
  const turned = orientation ? { orientation } : yaw === undefined ? {} : { yaw };
  const pose = { ...(position ? { position } : {}), ...turned };
  first.current = { ...fixed, ...pose };
  const { id, head } = fixed;

  useEffect(() => {
    if (!nafir) return undefined;
    let isWanted = true;
    let added = null;
    const tell = (listener, error) => isWanted && setThere({ listener, error });
    const left = ({ detail }) => {
      if (detail.id === added?.id) tell(null, new RefusedError(detail.message, detail.code, detail.id));
    };
    const isNew = id !== undefined && !nafir.listeners.has(id); // else it belongs to somebody else
    const entered = (listener) => {
      added = listener;
      if (isWanted) tell(listener, null);
      else listener.remove();
    };
    nafir.addEventListener("left", left);
    nafir.addListener(first.current).then(entered, (error) => tell(null, error));
    return () => {
      isWanted = false;
      nafir.removeEventListener("left", left);
      if (added) added.remove();
      else if (isNew) nafir.removeListener(id); // so that the id is free at once
      setThere({ listener: null, error: null });
    };
  }, [nafir, id, head]);

  useEffect(() => {
    there.listener?.move(pose);
  }, [there.listener, JSON.stringify(pose)]);
  return there;
}

/** Holds a door of the scene so far open, from 0, shut, to 1. It stays as it is when the component goes. */
export function useDoor(nafir, name, openness) {
  useEffect(() => nafir?.setDoor(name, openness), [nafir, name, openness]);
}
