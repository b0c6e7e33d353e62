// A flat with two sources. What binds sound to the picture is in `listen`: ten lines.

import * as THREE from "three";
import { connect } from "nafir-client";
import { bind, positionToThree } from "nafir-client/three";

const asked = new URLSearchParams(location.search);
const server = asked.get("server") ?? "http://127.0.0.1:8000";
const scene = asked.get("scene") ?? "apartment";

const world = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(70, 1, 0.05, 100);
const ball = new THREE.Mesh(new THREE.SphereGeometry(0.2), new THREE.MeshStandardMaterial({ color: 0xe8a13a }));
const cube = new THREE.Mesh(new THREE.BoxGeometry(0.3, 0.3, 0.3), new THREE.MeshStandardMaterial({ color: 0x4f9dde }));
const floor = new THREE.GridHelper(40, 40, 0x555b66, 0x2c3038);
world.add(ball, cube, floor, new THREE.HemisphereLight(0xffffff, 0x404040, 3));
camera.rotation.order = "YXZ";

async function listen() {
  const context = new AudioContext({ sampleRate: 48_000, latencyHint: "interactive" });
  const nafir = await connect(context, server, { scene });
  nafir.output.connect(context.destination);
  const { listener, emitter } = nafir.welcome.scene;
  camera.position.set(...positionToThree(listener.position));
  ball.position.set(...positionToThree(emitter.position));
  const sound = bind(nafir, camera);
  sound.add(ball, { clip: "woman-reading" });
  sound.add(cube, { clip: "trumpet", gainDb: -9 });
  return { nafir, sound };
}

let heard = null;
const held = new Set();
addEventListener("keydown", ({ key }) => held.add(key));
addEventListener("keyup", ({ key }) => held.delete(key));

function walk(seconds) {
  camera.rotation.y += 1.5 * seconds * (held.has("ArrowLeft") - held.has("ArrowRight"));
  const step = 1.4 * seconds * (held.has("ArrowUp") - held.has("ArrowDown"));
  camera.position.x -= step * Math.sin(camera.rotation.y);
  camera.position.z -= step * Math.cos(camera.rotation.y);
}

let before = performance.now();
function frame(now) {
  const seconds = (now - before) / 1000;
  before = now;
  walk(seconds);
  cube.position.set(ball.position.x + Math.sin(now / 2000), ball.position.y, ball.position.z + 0.5 * Math.cos(now / 2000));
  heard?.sound.update();
  return seconds;
}

const state = document.getElementById("state");
document.getElementById("start").addEventListener("click", async ({ target }) => {
  target.disabled = true;
  try {
    heard = await listen();
    window.example = { ...heard, camera, ball, cube }; // for the console
    heard.nafir.addEventListener("state", ({ detail }) => (state.textContent = detail.state));
    state.textContent = heard.nafir.state;
  } catch (error) {
    state.textContent = error.message;
    target.disabled = false;
  }
});

const renderer = new THREE.WebGLRenderer({ antialias: true });
document.body.append(renderer.domElement);
function resize() {
  renderer.setSize(innerWidth, innerHeight);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
}
addEventListener("resize", resize);
resize();
renderer.setAnimationLoop((now) => {
  frame(now);
  renderer.render(world, camera);
});
