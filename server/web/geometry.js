// Plane geometry of a floor plan. Points are [x, y] in metres; a plan is a closed polygon of corners.

export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

/** Angle wrapped to (-pi, pi]. */
export function wrapAngle(angle) {
  const turn = 2 * Math.PI;
  return angle - turn * Math.ceil((angle - Math.PI) / turn);
}

export function edges(corners) {
  return corners.map((corner, index) => [corner, corners[(index + 1) % corners.length]]);
}

export function contains(corners, [x, y]) {
  let inside = false;
  for (const [[ax, ay], [bx, by]] of edges(corners)) {
    if (ay > y !== by > y && x < ax + ((y - ay) / (by - ay)) * (bx - ax)) inside = !inside;
  }
  return inside;
}

/** Whether the open segments a-b and c-d cross. */
export function crosses(a, b, c, d) {
  const side = (p, q, r) => (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
  return side(a, b, c) * side(a, b, d) < 0 && side(c, d, a) * side(c, d, b) < 0;
}

export function isVisible(corners, a, b) {
  return !edges(corners).some(([c, d]) => crosses(a, b, c, d));
}

function nearestOnEdge([a, b], point) {
  const along = [b[0] - a[0], b[1] - a[1]];
  const t = ((point[0] - a[0]) * along[0] + (point[1] - a[1]) * along[1]) / (along[0] ** 2 + along[1] ** 2);
  const clamped = Math.min(1, Math.max(0, t));
  return [a[0] + clamped * along[0], a[1] + clamped * along[1]];
}

/** Places where the listener or a source may stand: inside the walls by `clearance` metres and inside the field's bounds. A clearance of
    null means that there are no walls. */
export class Floor {
  constructor({ corners, minimum, maximum, clearance = 0.15 }) {
    this.corners = corners;
    this.clearance = clearance;
    this.minimum = minimum;
    this.maximum = maximum;
  }

  #clamp(point) {
    return point.map((value, axis) => Math.min(this.maximum[axis], Math.max(this.minimum[axis], value)));
  }

  allows(point) {
    const inBounds = point.every((value, axis) => value >= this.minimum[axis] && value <= this.maximum[axis]);
    if (this.clearance === null) return inBounds;
    const clear = (edge) => distance(point, nearestOnEdge(edge, point)) >= this.clearance - 1e-6;
    return inBounds && contains(this.corners, point) && edges(this.corners).every(clear);
  }

  /** An allowed point near `point`, found by pushing it off the walls; null if the plan is too narrow. */
  nearest(point) {
    let candidate = this.#clamp(point);
    // Each pass handles one wall, so a corner takes two. The ends of inner walls take a few more.
    for (let pass = 0; pass < 8; pass++) {
      if (this.allows(candidate)) return candidate;
      candidate = this.#clamp(this.#pushed(candidate));
    }
    return this.allows(candidate) ? candidate : null;
  }

  #pushed(point) {
    let wall = null;
    let least = Infinity;
    let nearest = point;
    for (const edge of edges(this.corners)) {
      const foot = nearestOnEdge(edge, point);
      const gap = distance(point, foot);
      if (gap < least - 1e-9) [least, nearest, wall] = [gap, foot, edge];
    }
    const inside = contains(this.corners, point);
    const reach = this.clearance + 1e-4;
    if (least > 1e-6) {
      const sign = inside ? 1 : -1;
      const away = [(sign * (point[0] - nearest[0])) / least, (sign * (point[1] - nearest[1])) / least];
      return [nearest[0] + reach * away[0], nearest[1] + reach * away[1]];
    }
    const length = distance(...wall);
    const normal = [-(wall[1][1] - wall[0][1]) / length, (wall[1][0] - wall[0][0]) / length];
    const left = [nearest[0] + reach * normal[0], nearest[1] + reach * normal[1]];
    return contains(this.corners, left) ? left : [nearest[0] - reach * normal[0], nearest[1] - reach * normal[1]];
  }

  /** The end of a drag or a step from `from` towards `to`. It slides along walls and stays at `from` if there is no room. */
  slide(from, to) {
    return this.nearest(to) ?? from;
  }
}
