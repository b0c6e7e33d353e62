// A component that hears a scene, and one for each source in it.
//
//   npx esbuild react.jsx --bundle --format=esm --jsx=automatic --outfile=react.bundle.js

import { useState } from "react";
import { createRoot } from "react-dom/client";
import { useDoor, useEmitter, useListener, useNafir } from "nafir-client/react";

const asked = new URLSearchParams(location.search);
const server = asked.get("server") ?? "http://127.0.0.1:8000";
const scene = asked.get("scene") ?? "apartment";

function Source({ nafir, clip, x }) {
  useEmitter(nafir, { clip, position: [x, 3, 1.5] });
  return <li>{`${clip} at ${x} m`}</li>;
}

function Spectator({ nafir, x }) {
  const { listener, error } = useListener(nafir, { id: "spectator", position: [x, 2, 1.5] });
  window.spectator = listener;
  return <p id="spectator">{error ? error.message : listener ? `Another listener at ${x} m` : "..."}</p>;
}

function Door({ nafir, name }) {
  const [openness, setOpenness] = useState(nafir.welcome.doors[name]);
  useDoor(nafir, name, openness);
  return (
    <label>
      {name} <input type="range" min="0" max="1" step="0.1" value={openness} onChange={({ target }) => setOpenness(target.valueAsNumber)} />
    </label>
  );
}

function App() {
  // esbuild leaves workers and worklets where they are; `assets` says where that is.
  const { nafir, state, error, start, stop } = useNafir(server, { scene, assets: "./src/" });
  window.nafir = nafir; // for the console
  const [x, setX] = useState(6);
  const [isPlaying, setIsPlaying] = useState(true);
  const [isWatched, setIsWatched] = useState(false);
  return (
    <main>
      <button id="start" onClick={nafir ? stop : start}>{nafir ? "Stop" : "Listen"}</button>
      <p id="state">{error ? error.message : state}</p>
      <label>
        Place <input id="x" type="range" min="1" max="7" step="0.1" value={x} onChange={({ target }) => setX(target.valueAsNumber)} />
      </label>
      <label>
        <input id="playing" type="checkbox" checked={isPlaying} onChange={({ target }) => setIsPlaying(target.checked)} /> Trumpet
      </label>
      <label>
        <input id="watched" type="checkbox" checked={isWatched} onChange={({ target }) => setIsWatched(target.checked)} /> Another listener
      </label>
      {isWatched && <Spectator nafir={nafir} x={x} />}
      {Object.keys(nafir?.welcome.doors ?? {}).map((name) => <Door key={name} nafir={nafir} name={name} />)}
      <ul>{isPlaying && <Source nafir={nafir} clip="trumpet" x={x} />}</ul>
    </main>
  );
}

createRoot(document.getElementById("root")).render(<App />);
