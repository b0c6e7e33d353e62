// The static part of the floor plan, drawn on a canvas: walls (or the bounds if the walls are unknown), the loudness map on the floor,
// the lines of a cut through a mesh, and scales along the edges.

import { colour, loudnessRamp } from "./palette.js";

const WALL_M = 0.2;
const STEPS_M = [1, 2, 5, 10, 20, 50, 100]; // possible distances between the marks of a scale
const LEAST_STEP = 30; // pixels
const FADE_MS = 260;
const FINEST_MAP = 200; // pixels per metre

/** The mapping between world [x, y] in metres and CSS pixels. */
export class View {
  constructor({ corners, walled, width }) {
    const xs = corners.map(([x]) => x);
    const ys = corners.map(([, y]) => y);
    this.west = Math.min(...xs);
    this.south = Math.min(...ys);
    this.east = Math.max(...xs);
    this.north = Math.max(...ys);
    this.margin = width < 520 ? 26 : 36;
    this.wall = walled ? (width < 520 ? 6 : 10) : 0;
    this.width = width;
    const [left, right, above, below] = [this.margin, this.wall + 3, this.wall + 3, this.margin];
    this.scale = (width - left - right) / (this.east - this.west);
    // Inner walls are gaps between edges of the polygon. The strokes along both sides fill them.
    if (walled) this.wall = Math.max(this.wall, 0.5 * WALL_M * this.scale + 1);
    this.left = left;
    this.top = above;
    this.height = Math.round(above + below + this.scale * (this.north - this.south));
  }

  toScreen([x, y]) {
    return [this.left + (x - this.west) * this.scale, this.top + (this.north - y) * this.scale];
  }

  toWorld([x, y]) {
    return [this.west + (x - this.left) / this.scale, this.north - (y - this.top) / this.scale];
  }
}

export class Paper {
  #canvas;
  #corners;
  #walled;
  #view = null;
  #field = null;
  #scale = null;
  #map = null;
  #before = null;
  #fadeStart = 0;
  #stale = false;
  #lines = []; // [x, y, x, y] of a cut

  constructor(canvas, { corners, walls_known: walled }) {
    this.#canvas = canvas;
    this.#corners = corners;
    this.#walled = walled;
  }

  resize(view) {
    this.#view = view;
    const ratio = window.devicePixelRatio || 1;
    this.#canvas.width = Math.round(view.width * ratio);
    this.#canvas.height = Math.round(view.height * ratio);
    this.#canvas.style.height = `${view.height}px`;
    this.#repaintMap();
    this.draw();
  }

  /** Shows a LoudnessField on `scale` {bottom, top, band}, with a crossfade from the previous one. */
  show(field, scale) {
    this.#before = this.#map;
    this.#field = field;
    this.#scale = scale;
    this.#stale = false;
    this.#repaintMap();
    this.#fadeStart = performance.now();
    this.#fade();
  }

  /** Lines [x, y, x, y] to draw over the map: a cut through the scene. */
  set lines(lines) {
    this.#lines = lines;
    this.draw();
  }

  /** Whether the map is out of date; it is then drawn paler. */
  set stale(stale) {
    if (stale === this.#stale) return;
    this.#stale = stale;
    this.draw();
  }

  recolour() {
    this.#before = null;
    this.#repaintMap();
    this.draw();
  }

  #repaintMap() {
    if (!this.#field || !this.#view) return;
    // Twice the size on the screen, since scaling down smooths the edges of the bands.
    const pixelsPerMetre = Math.min(FINEST_MAP, 2 * this.#view.scale);
    this.#map = this.#field.paint(this.#scale, loudnessRamp(), pixelsPerMetre);
  }

  #fade() {
    const progress = (performance.now() - this.#fadeStart) / FADE_MS;
    this.draw(Math.min(1, progress));
    if (progress < 1) requestAnimationFrame(() => this.#fade());
    else this.#before = null;
  }

  #outline(context) {
    context.beginPath();
    this.#corners.forEach((corner, index) => {
      const [x, y] = this.#view.toScreen(corner);
      if (index === 0) context.moveTo(x, y);
      else context.lineTo(x, y);
    });
    context.closePath();
  }

  draw(progress = 1) {
    const view = this.#view;
    if (!view) return;
    const context = this.#canvas.getContext("2d");
    const ratio = this.#canvas.width / view.width;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, view.width, view.height);
    if (this.#walled) this.#drawWalls(context);
    context.save();
    this.#outline(context);
    context.clip();
    context.fillStyle = colour("--floor");
    context.fillRect(0, 0, view.width, view.height);
    if (this.#before) this.#drawMap(context, this.#before, 1);
    if (this.#map) this.#drawMap(context, this.#map, (this.#before ? progress : 1) * (this.#stale ? 0.45 : 1));
    context.restore();
    if (this.#lines.length > 0) this.#drawLines(context);
    else if (!this.#walled) this.#drawBounds(context);
    this.#drawMeasures(context);
  }

  #drawMap(context, map, alpha) {
    const { west, north, east, south } = this.#view;
    const [left, top] = this.#view.toScreen([west, north]);
    const [right, bottom] = this.#view.toScreen([east, south]);
    context.globalAlpha = alpha;
    context.imageSmoothingQuality = "high";
    context.drawImage(map, left, top, right - left, bottom - top);
    context.globalAlpha = 1;
  }

  #drawWalls(context) {
    this.#outline(context);
    context.lineJoin = "miter";
    context.strokeStyle = colour("--wall");
    context.lineWidth = 2 * this.#view.wall;
    context.stroke();
  }

  #drawLines(context) {
    context.beginPath();
    for (const [x0, y0, x1, y1] of this.#lines) {
      context.moveTo(...this.#view.toScreen([x0, y0]));
      context.lineTo(...this.#view.toScreen([x1, y1]));
    }
    context.strokeStyle = colour("--wall");
    context.lineWidth = 1.75;
    context.lineCap = "round";
    context.stroke();
    context.lineCap = "butt";
  }

  #drawBounds(context) {
    this.#outline(context);
    context.strokeStyle = colour("--faint");
    context.lineWidth = 1;
    context.setLineDash([5, 5]);
    context.stroke();
    context.setLineDash([]);
  }

  #drawMeasures(context) {
    const view = this.#view;
    const tick = 4;
    context.strokeStyle = context.fillStyle = colour("--faint");
    context.lineWidth = 1;
    context.font = `500 ${view.width < 520 ? 10 : 11}px ${getComputedStyle(this.#canvas).fontFamily}`;
    const gap = view.wall + 3;
    const step = STEPS_M.find((metres) => metres * view.scale >= LEAST_STEP) ?? STEPS_M.at(-1);
    const line = (x0, y0, x1, y1) => {
      context.beginPath();
      context.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
      context.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
      context.stroke();
    };
    context.textAlign = "center";
    context.textBaseline = "top";
    for (let metre = 0; metre <= view.east - view.west + 1e-6; metre += step) {
      const [x, y] = view.toScreen([view.west + metre, view.south]);
      line(x, y + gap, x, y + gap + tick);
      const label = `${metre}`;
      // The last one may end beyond the plan, where nothing is left of the canvas.
      const most = view.width - context.measureText(label).width / 2 - 1;
      context.fillText(label, Math.min(x, most), y + gap + tick + 2);
    }
    context.textAlign = "right";
    context.textBaseline = "middle";
    const least = context.measureText("0").fontBoundingBoxAscent / 2 + 1;
    for (let metre = 0; metre <= view.north - view.south + 1e-6; metre += step) {
      const [x, y] = view.toScreen([view.west, view.south + metre]);
      line(x - gap - tick, y, x - gap, y);
      if (metre > 0) context.fillText(`${metre}`, x - gap - tick - 3, Math.max(y, least));
    }
  }
}
