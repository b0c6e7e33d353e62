// Compiled by test_javascript.py, not run: what a user writes has the types that it should.

import * as THREE from "three";
import { connect, deleteClip, microphone, RefusedError, uploadClip, type Emitter, type Latency, type Listener } from "nafir-client";
import { Field, type Channels } from "nafir-client/field";
import { bind, poseOf } from "nafir-client/three";
import { useDoor, useEmitter, useListener, useNafir } from "nafir-client/react";

export async function listen(context: AudioContext): Promise<Latency | null> {
  const nafir = await connect(context, "https://sound.example", { scene: "apartment", order: 1, signal: AbortSignal.timeout(5000) });
  nafir.output.connect(context.destination);
  const radio: Emitter = nafir.addEmitter({ clip: "woman-reading", position: [6, 3, 1.5], directivity: { pattern: "cardioid" } });
  radio.position = [5, 3, 1.5];
  radio.gainDb = -6;
  nafir.addEmitter({ source: await microphone(context), position: [1, 2, 1.5], yaw: 0.5 });
  nafir.listener.yaw = 1;
  const bell = nafir.addEmitter({
    clip: "trumpet", position: [1, 2, 1.5], loop: false, startAt: nafir.sampleClock + 100, offsetS: 0.5, removeWhenEnded: true,
  });
  nafir.addEmitter({ clip: await nafir.upload(new Blob()), position: [1, 2, 1.5], loopStartS: 0.1, loopEndS: 0.2, stopAt: 48_000 });
  nafir.addEmitter({ position: [1, 2, 1.5], jitterMs: 40 });
  bell.setGain(-6, { rampS: 0.5 });
  bell.stop({ fadeS: 0.5, at: 96_000 });
  nafir.addEventListener("ended", ({ detail }) => console.log(detail.id === bell.id && detail.removed, bell.hasEnded));
  await deleteClip("https://sound.example", await uploadClip("https://sound.example", new ArrayBuffer(8), { title: "A door" }));
  // @ts-expect-error  a clock is a number
  nafir.addEmitter({ clip: "trumpet", position: [1, 2, 1.5], startAt: "now" });
  for (const door of Object.keys(nafir.welcome?.doors ?? {})) nafir.setDoor(door, 0.5);
  nafir.listener.move({ position: [1, 1, 1.6], orientation: [0, 0, 0, 1] });
  nafir.addEventListener("refused", ({ detail }) => console.warn(detail.code, detail.message));
  nafir.addEventListener("state", ({ detail }) => console.log(detail.state, detail.retryMs ?? 0));
  const second: Listener = await nafir.addListener({ position: [3, 1, 1.6], yaw: 0.5, head: "kemar" });
  second.output.connect(context.destination);
  second.move({ position: [3, 2, 1.6] });
  console.log(second.statistics.late + nafir.statistics.underruns);
  bind(nafir, new THREE.PerspectiveCamera(), second).update();
  nafir.addEventListener("left", ({ detail }) => console.warn(detail.id, detail.code));
  const spectator = await nafir.addListener().catch((error: RefusedError) => error.listener);
  console.log(typeof spectator === "string" ? spectator : spectator?.latency.direct?.totalMs, nafir.listeners.get("listener-2") === second);
  second.remove();
  const binding = bind(nafir, new THREE.PerspectiveCamera());
  binding.add(new THREE.Object3D(), { clip: "trumpet" });
  binding.update();
  // @ts-expect-error  a position has three numbers
  radio.position = [1, 2];
  // @ts-expect-error  an emitter has a position
  nafir.addEmitter({ clip: "trumpet" });
  // @ts-expect-error  a scene is rendered here or by the server
  await connect(context, "", { scene: "apartment", rendered: "there" });
  // @ts-expect-error  a door has a name, and is so far open
  nafir.setDoor("front");
  // @ts-expect-error  a listener has no clip
  await nafir.addListener({ clip: "trumpet" });
  // @ts-expect-error  ambisonics end at order 3
  await connect(context, "", { scene: "apartment", order: 4 });
  return nafir.latency.direct;
}

export function Hook(): string {
  const { nafir, state, error, start } = useNafir("/", { scene: "apartment" });
  const emitter = useEmitter(nafir, { clip: "trumpet", position: [1, 2, 3] });
  const { listener, error: problem } = useListener(nafir, { position: [1, 2, 1.5], head: "kemar" });
  useDoor(nafir, "kitchen", listener && !problem ? 1 : 0);
  void start();
  return error instanceof RefusedError ? `${error.code}` : `${state} ${emitter?.id} ${poseOf(new THREE.Object3D()).position[0]}`;
}

export async function compute(): Promise<Float32Array> {
  const field = await Field.load("https://sound.example", "apartment", { level: "directional-bands", key: null });
  const path = field.directPath([1, 2, 1.5], [6, 3, 1.5]);
  const [w]: Channels = field.reflections([1, 2, 1.5], [6, 3, 1.5], path);
  // @ts-expect-error  a position has three numbers
  field.response([1, 2], [6, 3, 1.5]);
  return w;
}
