// Keyboard: W and S or the up and down arrows walk, A and D sidestep, the left and right arrows or Q and E turn. With a source
// focused the arrows and WASD move the source along the plan instead.

const WALK_M_S = 1.3;
const SOURCE_M_S = 1.3;
const TURN_RAD_S = 1.9;
const HURRY = 2.2; // factor of the speed with shift
const STRIDE_S = 0.02; // longest step in time, so that no step crosses a wall even if the page is drawn rarely

const KEYS = {
  KeyW: "forward", ArrowUp: "forward", KeyS: "back", ArrowDown: "back", KeyA: "left", KeyD: "right",
  ArrowLeft: "turnLeft", KeyQ: "turnLeft", ArrowRight: "turnRight", KeyE: "turnRight",
};

export class Walking {
  #world;
  #focusedEmitter;
  #dropped;
  #pressed = new Map(); // code -> action
  #hurry = false;
  #last = 0;
  #frame = 0;
  #movedEmitter = null;

  /** `focusedEmitter()` returns the id of the emitter with the keyboard focus, or null. `dropped(id)` is called when it comes to rest. */
  constructor(world, { focusedEmitter, dropped }) {
    this.#world = world;
    this.#focusedEmitter = focusedEmitter;
    this.#dropped = dropped;
    window.addEventListener("keydown", (event) => this.#down(event));
    window.addEventListener("keyup", (event) => this.#up(event));
    window.addEventListener("blur", () => this.#release());
  }

  #down(event) {
    this.#hurry = event.shiftKey;
    const action = KEYS[event.code];
    if (!action || event.ctrlKey || event.altKey || event.metaKey || takesKey(event)) return;
    event.preventDefault();
    this.#pressed.set(event.code, action);
    if (!this.#frame) {
      this.#last = performance.now();
      this.#frame = requestAnimationFrame((time) => this.#step(time));
    }
  }

  #up(event) {
    this.#hurry = event.shiftKey;
    this.#pressed.delete(event.code);
  }

  #release() {
    this.#pressed.clear();
  }

  #step(time) {
    const seconds = Math.min(0.1, Math.max(0, (time - this.#last) / 1000));
    this.#last = time;
    const active = new Set(this.#pressed.values());
    const axis = (plus, minus) => (active.has(plus) ? 1 : 0) - (active.has(minus) ? 1 : 0);
    const emitter = this.#focusedEmitter();
    for (let left = active.size > 0 ? seconds : 0; left > 0; left -= STRIDE_S) {
      const pace = Math.min(left, STRIDE_S) * (this.#hurry ? HURRY : 1);
      if (emitter) this.#moveEmitter(emitter, axis, pace);
      else this.#walk(axis, pace);
    }
    if (this.#pressed.size > 0) {
      this.#frame = requestAnimationFrame((next) => this.#step(next));
    } else {
      this.#frame = 0;
      if (this.#movedEmitter) this.#dropped(this.#movedEmitter);
      this.#movedEmitter = null;
    }
  }

  #walk(axis, pace) {
    const { position, yaw } = this.#world.listener;
    const heading = yaw + axis("turnLeft", "turnRight") * TURN_RAD_S * pace;
    const ahead = axis("forward", "back") * WALK_M_S * pace;
    const aside = axis("left", "right") * WALK_M_S * pace;
    const x = position[0] + ahead * Math.cos(heading) - aside * Math.sin(heading);
    const y = position[1] + ahead * Math.sin(heading) + aside * Math.cos(heading);
    this.#world.moveListener(ahead || aside ? [x, y] : null, heading);
  }

  #moveEmitter(id, axis, pace) {
    const [x, y] = this.#world.emitters.get(id).position;
    const east = axis("right", "left") + axis("turnRight", "turnLeft");
    const north = axis("forward", "back");
    this.#world.moveEmitter(id, [x + SOURCE_M_S * pace * Math.sign(east), y + SOURCE_M_S * pace * north]);
    this.#movedEmitter = id;
  }
}

/** Whether the focused control uses this key itself. */
export function takesKey({ target, code }) {
  if (!(target instanceof Element)) return false;
  if (target.closest("select, textarea, [contenteditable]")) return true;
  const input = target.closest("input");
  return input !== null && (input.type !== "range" || code.startsWith("Arrow"));
}
