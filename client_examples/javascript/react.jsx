// A component that hears a scene, and one for each source in it.
//
//   npx esbuild react.jsx --bundle --format=esm --jsx=automatic --outfile=react.bundle.js

import { useState } from "react";
import { createRoot } from "react-dom/client";
import { useEmitter, useNafir } from "nafir-client/react";

const asked = new URLSearchParams(location.search);
const server = asked.get("server") ?? "http://127.0.0.1:8000";
const scene = asked.get("scene") ?? "apartment";

function Source({ nafir, clip, x }) {
  useEmitter(nafir, { clip, position: [x, 3, 1.5] });
  return <li>{`${clip} at ${x} m`}</li>;
}

function App() {
  // esbuild leaves workers and worklets where they are; `assets` says where that is.
  const { nafir, state, error, start, stop } = useNafir(server, { scene, assets: "./src/" });
  window.nafir = nafir; // for the console
  const [x, setX] = useState(6);
  const [isPlaying, setIsPlaying] = useState(true);
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
      <ul>{isPlaying && <Source nafir={nafir} clip="trumpet" x={x} />}</ul>
    </main>
  );
}

createRoot(document.getElementById("root")).render(<App />);
