import type { ConnectOptions, Emitter, EmitterOptions, Listener, ListenerOptions, Nafir, State } from "./index.js";

export interface NafirHook {
  nafir: Nafir | null;
  state: State | "idle";
  error: Error | null;
  /** Call it by a click or a key: browsers allow sound only then. */
  start(): Promise<void>;
  stop(): void;
}

export function useNafir(url: string | URL, options: Omit<ConnectOptions, "signal"> & { context?: AudioContext }): NafirHook;
export function useEmitter(nafir: Nafir | null, options: EmitterOptions): Emitter | null;
export function useListener(nafir: Nafir | null, options?: ListenerOptions): { listener: Listener | null; error: Error | null };
export function useDoor(nafir: Nafir | null, name: string, openness: number): void;
