// Loudness maps: levels on a grid are drawn as filled bands of a few decibels, like depths on a chart.
// A grid is {levels (rows of numbers, NaN outside), origin [x, y], spacingM}. Row 0 is the southernmost.

import { contains, crosses, edges } from "./geometry.js";

const BAND_WIDTHS_DB = [1, 2, 3, 5];
const MOST_BANDS = 10;
const WIDTH = 1.25;
const REACH = 1.5 * WIDTH; // half-width of the spline, in grid steps
const RIDGE = 1e-3;
const FINEST_M = 0.05;
const FINE_STEPS = 5; // steps of the fine grid in one step of the coarse grid, unless FINEST_M limits it
const NEARBY = [[0, 0], [1, 1], [-1, 1], [1, -1], [-1, -1]];

export function parseGrid({ levels_db: rows, origin, spacing_m: spacingM }) {
  return { levels: rows.map((row) => row.map((level) => level ?? NaN)), origin, spacingM };
}

/** The grid with all levels raised by `gainDb`. */
export function raised(grid, gainDb) {
  return { ...grid, levels: grid.levels.map((levels) => levels.map((level) => level + gainDb)) };
}

/** The energetic sum of several emitters' grids over the same points. */
export function combine(grids) {
  const [first, ...rest] = grids;
  const power = (grid, row, column) => 10 ** (grid.levels[row][column] / 10);
  const sum = (level, row, column) =>
    10 * Math.log10(rest.reduce((total, grid) => total + power(grid, row, column), 10 ** (level / 10)));
  return { ...first, levels: first.levels.map((levels, row) => levels.map((level, column) => sum(level, row, column))) };
}

/**
 * A scale {bottom, top, band} in decibels that fits a grid. The loudest few points may lie above it, since the level near a source has
 * no limit. The quietest may lie below it if the range is too large even for the widest bands.
 */
export function scaleOf(grid) {
  const levels = grid.levels.flat().filter(Number.isFinite).sort((a, b) => a - b);
  if (levels.length === 0) return null;
  const loud = levels[Math.floor(0.985 * (levels.length - 1))];
  const band = BAND_WIDTHS_DB.find((width) => (loud - levels[0]) / width <= MOST_BANDS - 1) ?? BAND_WIDTHS_DB.at(-1);
  const top = band * Math.ceil(loud / band);
  const bottom = Math.max(top - MOST_BANDS * band, Math.min(top - 2 * band, band * Math.floor(levels[0] / band)));
  return { bottom, top, band };
}

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

/** A quadratic B-spline a little wider than the grid. Contours are smooth, and the shadow behind a wall stays visible. */
function spline(t) {
  const x = Math.abs(t) / WIDTH;
  if (x < 0.5) return 0.75 - x * x;
  return x < 1.5 ? 0.5 * (1.5 - x) ** 2 : 0;
}

/** A weighted least-squares fit of a plane, evaluated at x = y = 0. A weighted mean would bend contours along every wall. */
class PlaneFit {
  #s = new Float64Array(9); // w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz

  add(w, x, y, z) {
    [w, w * x, w * y, w * x * x, w * x * y, w * y * y, w * z, w * x * z, w * y * z].forEach((term, index) => {
      this.#s[index] += term;
    });
  }

  /** The plane's value; NaN if no point is near. The ridge keeps the plane level in a direction in which the points do not vary. */
  value() {
    const [w, x, y, xx0, xy, yy0, z, xz, yz] = this.#s;
    if (w < 1e-4) return NaN;
    const [xx, yy] = [xx0 + RIDGE * w, yy0 + RIDGE * w];
    const determinant = w * (xx * yy - xy * xy) - x * (x * yy - xy * y) + y * (x * xy - xx * y);
    return (z * (xx * yy - xy * xy) - x * (xz * yy - xy * yz) + y * (xz * xy - xx * yz)) / determinant;
  }
}

/** Levels at any point of a floor plan, interpolated from those grid points that no wall hides from it. */
export class LoudnessField {
  constructor(grid, corners) {
    this.grid = grid;
    this.corners = corners;
    this.fineM = Math.max(FINEST_M, grid.spacingM / FINE_STEPS);
    this.walls = edges(corners);
    const xs = corners.map(([x]) => x);
    const ys = corners.map(([, y]) => y);
    this.minimum = [Math.min(...xs), Math.min(...ys)];
    this.columns = Math.round((Math.max(...xs) - this.minimum[0]) / this.fineM) + 1;
    this.rows = Math.round((Math.max(...ys) - this.minimum[1]) / this.fineM) + 1;
    this.fine = new Float32Array(this.rows * this.columns);
    for (let row = 0; row < this.rows; row++) {
      for (let column = 0; column < this.columns; column++) {
        const point = [this.minimum[0] + column * this.fineM, this.minimum[1] + row * this.fineM];
        this.fine[row * this.columns + column] = this.#weighted(point);
      }
    }
    // Points inside walls and close to them, which no grid point reaches, get the mean of their neighbours.
    for (let pass = 0; pass < 12; pass++) this.#spread();
  }

  #weighted(point) {
    const eye = this.#stepInside(point);
    if (!eye) return NaN;
    const { levels, origin, spacingM } = this.grid;
    const x = (point[0] - origin[0]) / spacingM;
    const y = (point[1] - origin[1]) / spacingM;
    // The grid ends before the walls. Its slope continues for one cell, and the level is constant beyond.
    const [u, v] = [clamp(x, 0, levels[0].length - 1), clamp(y, 0, levels.length - 1)];
    const [atX, atY] = [clamp(x, u - 1, u + 1), clamp(y, v - 1, v + 1)];
    const fit = new PlaneFit();
    for (let row = Math.max(0, Math.ceil(v - REACH)); row <= Math.min(levels.length - 1, v + REACH); row++) {
      for (let column = Math.max(0, Math.ceil(u - REACH)); column <= Math.min(levels[0].length - 1, u + REACH); column++) {
        const level = levels[row][column];
        if (!Number.isFinite(level)) continue;
        const there = [origin[0] + column * spacingM, origin[1] + row * spacingM];
        if (this.walls.some(([a, b]) => crosses(eye, there, a, b))) continue;
        fit.add(spline(u - column) * spline(v - row), column - atX, row - atY, level);
      }
    }
    return fit.value();
  }

  /** The point itself, or one a step away if it lies on a wall; null inside a wall. */
  #stepInside([x, y]) {
    for (const [dx, dy] of NEARBY) {
      const eye = [x + 0.3 * this.fineM * dx, y + 0.3 * this.fineM * dy];
      if (contains(this.corners, eye)) return eye;
    }
    return null;
  }

  #spread() {
    const before = this.fine.slice();
    for (let row = 0; row < this.rows; row++) {
      for (let column = 0; column < this.columns; column++) {
        const at = row * this.columns + column;
        if (Number.isFinite(before[at])) continue;
        let sum = 0;
        let count = 0;
        for (const [dr, dc] of [[0, 1], [0, -1], [1, 0], [-1, 0]]) {
          const [r, c] = [row + dr, column + dc];
          if (r < 0 || c < 0 || r >= this.rows || c >= this.columns) continue;
          const level = before[r * this.columns + c];
          if (Number.isFinite(level)) [sum, count] = [sum + level, count + 1];
        }
        if (count > 0) this.fine[at] = sum / count;
      }
    }
  }

  /** The level in dB at [x, y]; NaN outside the floor. */
  at([x, y]) {
    const u = Math.min(this.columns - 1.001, Math.max(0, (x - this.minimum[0]) / this.fineM));
    const v = Math.min(this.rows - 1.001, Math.max(0, (y - this.minimum[1]) / this.fineM));
    const [column, row] = [Math.floor(u), Math.floor(v)];
    const [s, t] = [u - column, v - row];
    const at = row * this.columns + column;
    const below = this.fine[at] * (1 - s) + this.fine[at + 1] * s;
    const above = this.fine[at + this.columns] * (1 - s) + this.fine[at + this.columns + 1] * s;
    return below * (1 - t) + above * t;
  }

  /** The map as a canvas of `pixelsPerMetre` with row 0 in the north; `ramp(fraction)` gives [r, g, b] for 0 (quiet) to 1 (loud). */
  paint({ bottom, top, band: width }, ramp, pixelsPerMetre) {
    const columns = Math.round((this.columns - 1) * this.fineM * pixelsPerMetre);
    const rows = Math.round((this.rows - 1) * this.fineM * pixelsPerMetre);
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [columns, rows];
    const context = canvas.getContext("2d");
    const image = context.createImageData(columns, rows);
    const bands = Math.round((top - bottom) / width);
    const colours = Array.from({ length: bands }, (_, band) => ramp(band / (bands - 1)));
    for (let row = 0, offset = 0; row < rows; row++) {
      const y = this.minimum[1] + (rows - row - 0.5) / pixelsPerMetre;
      for (let column = 0; column < columns; column++, offset += 4) {
        const level = this.at([this.minimum[0] + (column + 0.5) / pixelsPerMetre, y]);
        if (Number.isNaN(level)) continue;
        const band = Math.min(bands - 1, Math.max(0, Math.floor((level - bottom) / width)));
        const [r, g, b] = colours[band];
        image.data[offset] = r;
        image.data[offset + 1] = g;
        image.data[offset + 2] = b;
        image.data[offset + 3] = 255;
      }
    }
    context.putImageData(image, 0, 0);
    return canvas;
  }
}
