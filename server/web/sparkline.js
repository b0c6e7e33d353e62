// A strip chart of the playout buffer over the last seconds. The fill is an area, the target a line, and dropouts are marks.

import { colour } from "./palette.js";

const SPAN_MS = 12_000;

export class Sparkline {
  #canvas;
  #points = []; // {at, value, target, dropout}

  constructor(canvas) {
    this.#canvas = canvas;
  }

  clear() {
    this.#points = [];
    this.draw();
  }

  add(point) {
    this.#points.push(point);
    while (this.#points.length > 0 && this.#points[0].at < point.at - SPAN_MS) this.#points.shift();
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.#canvas;
    const ratio = window.devicePixelRatio || 1;
    const [pixelWidth, pixelHeight] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (this.#canvas.width !== pixelWidth) this.#canvas.width = pixelWidth;
    if (this.#canvas.height !== pixelHeight) this.#canvas.height = pixelHeight;
    const context = this.#canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.fillStyle = colour("--line");
    context.fillRect(0, height - 1, width, 1);
    if (this.#points.length === 0) return;
    const latest = this.#points.at(-1);
    const ceiling = Math.max(120, ...this.#points.map(({ value }) => value * 1.15));
    const x = ({ at }) => width * (1 - (latest.at - at) / SPAN_MS);
    const y = (value) => height - 1 - (height - 4) * (value / ceiling);
    this.#drawFill(context, x, y, height);
    const target = Math.round(y(latest.target)) + 0.5;
    context.strokeStyle = colour("--quiet");
    context.setLineDash([2, 3]);
    context.beginPath();
    context.moveTo(0, target);
    context.lineTo(width, target);
    context.stroke();
    context.setLineDash([]);
    context.fillStyle = colour("--alarm");
    for (const point of this.#points) if (point.dropout) context.fillRect(x(point) - 1, 0, 2, height - 1);
  }

  #drawFill(context, x, y, height) {
    const trace = () => this.#points.forEach((point) => context.lineTo(x(point), y(point.value)));
    context.fillStyle = colour("--buffer-wash");
    context.beginPath();
    context.moveTo(x(this.#points[0]), height - 1);
    trace();
    context.lineTo(x(this.#points.at(-1)), height - 1);
    context.fill();
    context.strokeStyle = colour("--buffer");
    context.lineWidth = 1.5;
    context.beginPath();
    trace();
    context.stroke();
    context.lineWidth = 1;
  }
}
