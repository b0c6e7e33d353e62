// Turning with a phone: the listener turns as the phone in the hand does. Emits "turned" with the angle in radians, counter-clockwise.
//
// What counts is the heading of the phone's top and back together (W3C Device Orientation: the device's axes are x right, y up along the
// screen and z out of it). The top alone has no heading while the phone is upright, the back none while it lies flat.

import { wrapAngle } from "./geometry.js";

const RADIANS = Math.PI / 180;

/** The heading in radians, counter-clockwise from east, of a device with these angles in degrees. */
export function headingOf({ alpha, beta, gamma }) {
  const [a, b, c] = [alpha, beta, gamma].map((angle) => angle * RADIANS);
  const [sinA, cosA, sinB, cosB, sinC, cosC] = [Math.sin(a), Math.cos(a), Math.sin(b), Math.cos(b), Math.sin(c), Math.cos(c)];
  // Second column of Rz(alpha) Rx(beta) Ry(gamma) less the third: where the top and the back point.
  const east = -sinA * cosB - (cosA * sinC + sinA * sinB * cosC);
  const north = cosA * cosB - (sinA * sinC - cosA * sinB * cosC);
  return Math.atan2(north, east);
}

export class PhoneTurning extends EventTarget {
  #button;
  #isOn = false;
  #heading = null;
  #turned = (event) => this.#turn(event);

  /** `button` switches it. It stays hidden where there is no touch screen, since a computer does not turn with its listener. */
  constructor(button) {
    super();
    this.#button = button;
    button.hidden = !("DeviceOrientationEvent" in window) || !matchMedia("(pointer: coarse)").matches;
    button.addEventListener("click", () => (this.#isOn ? this.#stop() : this.#start()));
  }

  async #start() {
    // Safari asks its user, and only after a tap.
    const asked = await window.DeviceOrientationEvent.requestPermission?.().catch(() => "denied");
    if (asked === "denied") {
      this.dispatchEvent(new Event("denied"));
      return;
    }
    this.#isOn = true;
    this.#heading = null;
    this.#button.setAttribute("aria-pressed", true);
    window.addEventListener("deviceorientation", this.#turned);
  }

  #stop() {
    this.#isOn = false;
    this.#button.setAttribute("aria-pressed", false);
    window.removeEventListener("deviceorientation", this.#turned);
  }

  #turn(event) {
    if (event.alpha === null) return; // a device without the sensor says so once
    const heading = headingOf(event);
    if (this.#heading !== null) this.dispatchEvent(new CustomEvent("turned", { detail: wrapAngle(heading - this.#heading) }));
    this.#heading = heading;
  }
}
