"""Draws pictures of a furnished flat: rays against rectangles, procedural textures, lamps with soft shadows, and
ambient occlusion.

Light falls on every surface the same from wherever it is looked at, as a network that learns from the pictures
assumes. So it is computed once, on a raster of each rectangle, and looked up between its points.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from training.sight.cameras import Camera
from training.sight.flat import Flat, Kind, Surfaces

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]

_RAYS_AT_A_TIME = 512
_TEXEL_M = 0.12
_SKIN_M = 1e-4
_LAMP_RADIUS_M = 0.16
_OCCLUSION_RAYS = 40
_OCCLUSION_M = 0.7
_LAMP_POWER, _AMBIENT, _GLOW = 2.6, 0.42, 2.0
_SAMPLES = 2
"""Rays of a pixel along each axis."""


class Hits(NamedTuple):
    """`depth_m` (ray,) distances to the first rectangle, infinite without one; `surface` (ray,) its number; `place`
    (ray, 2) where on it, as shares of its edges."""

    depth_m: _Floats
    surface: _Integers
    place: _Floats


def cast(surfaces: Surfaces, origins: _Floats, directions: _Floats) -> Hits:
    """Find the rectangle that each ray meets first. `origins` are (ray, 3), `directions` (ray, 3) of length one."""
    depth_m, number, place = np.empty(len(origins)), np.empty(len(origins), np.int64), np.empty((len(origins), 2))
    ahead = np.einsum("sk,sk->s", surfaces.normal, surfaces.origin)
    edges = [edge / np.sum(edge**2, axis=-1, keepdims=True) for edge in (surfaces.along, surfaces.up)]
    starts = [np.einsum("sk,sk->s", edge, surfaces.origin) for edge in edges]
    for begin in range(0, len(origins), _RAYS_AT_A_TIME):
        some = slice(begin, begin + _RAYS_AT_A_TIME)
        origin, direction = origins[some], directions[some]
        towards = direction @ surfaces.normal.T
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (ahead - origin @ surfaces.normal.T) / towards
            first, second = (
                origin @ edge.T - start + distance * (direction @ edge.T)
                for edge, start in zip(edges, starts, strict=True)
            )
        meets = (towards < 0) & (distance > _SKIN_M) & (np.abs(first - 0.5) <= 0.5) & (np.abs(second - 0.5) <= 0.5)
        distance[~meets] = np.inf
        nearest = np.argmin(distance, axis=1)
        rows = np.arange(len(origin))
        depth_m[some], number[some] = distance[rows, nearest], nearest
        place[some] = np.stack([first[rows, nearest], second[rows, nearest]], axis=-1)
    return Hits(depth_m, number, place)


class _Spots(NamedTuple):
    """Spots on one kind of surface: `points` (spot, 3) in the scene; `metres` and `place` (spot, 2) along the edges of
    their rectangle, in metres and as shares; `styles` (spot,)."""

    points: _Floats
    metres: _Floats
    styles: _Integers
    place: _Floats


@dataclass(frozen=True)
class _Raster:
    """Light on the points of all rectangles, one after the other: `values` (point, 3); rectangle i has `counts[i]`
    (across, up) points from `starts[i]` on."""

    values: _Floats
    starts: _Integers
    counts: _Integers

    def at(self, surface: _Integers, place: _Floats) -> _Floats:
        """(ray, 3) light, bilinearly interpolated."""
        counts = self.counts[surface]
        position = np.clip(place * counts - 0.5, 0, counts - 1)
        low = np.minimum(position.astype(np.int64), np.maximum(counts - 2, 0))
        share = position - low
        high = np.minimum(low + 1, counts - 1)
        total = np.zeros((len(surface), 3))
        for across, x in ((low[:, 0], 1 - share[:, 0]), (high[:, 0], share[:, 0])):
            for up, y in ((low[:, 1], 1 - share[:, 1]), (high[:, 1], share[:, 1])):
                total += self.values[self.starts[surface] + up * counts[:, 0] + across] * (x * y)[:, None]
        return total


class Drawing:
    """A flat with its light, ready to be drawn from any camera."""

    def __init__(self, flat: Flat, seed: int) -> None:
        self._flat, self._surfaces = flat, flat.surfaces
        rng = np.random.default_rng([seed, 12])
        rooms = len(flat.rooms)
        self._paint = 0.45 + 0.45 * rng.random((rooms, 3))
        self._wood = np.array([0.55, 0.38, 0.24]) * rng.uniform(0.7, 1.25, (rooms, 1))
        self._lamp_colour = np.stack([np.ones(rooms), rng.uniform(0.82, 0.95, rooms), rng.uniform(0.6, 0.9, rooms)], -1)
        self._raster = self._light(rng)

    def picture(self, camera: Camera) -> npt.NDArray[np.uint8]:
        """(height, width, 3) as the camera sees it, in sRGB."""
        total = np.zeros((camera.height * camera.width, 3))
        offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
        for dx in offsets:
            for dy in offsets:
                total += self.colours(*camera.rays(dx, dy))
        linear = (total / _SAMPLES**2).reshape(camera.height, camera.width, 3)
        return np.round(255 * linear ** (1 / 2.2)).astype(np.uint8)

    def colours(self, origins: _Floats, directions: _Floats) -> _Floats:
        """(ray, 3) linear colours, 0 to 1."""
        hits = cast(self._surfaces, origins, directions)
        met = np.isfinite(hits.depth_m)
        points = origins + np.where(met, hits.depth_m, 0.0)[:, None] * directions
        albedo = self._albedo(hits.surface, hits.place, points)
        light = self._raster.at(hits.surface, np.clip(hits.place, 0, 1))
        light[self._surfaces.kind[hits.surface] == Kind.LAMP] = _GLOW
        shone = albedo * light
        return np.asarray(np.where(met[:, None], shone / (1 + 0.45 * shone), 0.0).clip(0, 1))

    def _light(self, rng: np.random.Generator) -> _Raster:
        surfaces = self._surfaces
        counts = np.maximum(1, np.round(surfaces.size_m / _TEXEL_M)).astype(np.int64)
        starts = np.concatenate([[0], np.cumsum(counts.prod(axis=1))[:-1]])
        owner = np.repeat(np.arange(len(counts)), counts.prod(axis=1))
        within = np.arange(len(owner)) - starts[owner]
        place = np.stack([within % counts[owner, 0], within // counts[owner, 0]], axis=-1) + 0.5
        place = place / counts[owner]
        points = surfaces.origin[owner] + place[:, :1] * surfaces.along[owner] + place[:, 1:] * surfaces.up[owner]
        points += 2e-3 * surfaces.normal[owner]
        lit = self._flat.is_free(points, 1e-3)
        values = np.zeros((len(owner), 3))
        values[lit] = self._falling(points[lit], surfaces.normal[owner[lit]], rng)
        # Points inside walls and furniture take the light of the nearest point outside, or else it would be dark
        # around them.
        for number, (across, up) in enumerate(counts):
            some = slice(starts[number], starts[number] + across * up)
            mask = lit[some].reshape(up, across)
            if mask.any() and not mask.all():
                nearest = distance_transform_edt(~mask, return_distances=False, return_indices=True)
                values[some] = values[some].reshape(up, across, 3)[tuple(nearest)].reshape(-1, 3)
        return _Raster(values, starts, counts)

    def _falling(self, points: _Floats, normals: _Floats, rng: np.random.Generator) -> _Floats:
        """(point, 3) light that falls on points of surfaces."""
        blockers = self._without_lamps
        first = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        tangent = np.cross(normals, first)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        across = np.cross(normals, tangent)
        # Directions spread like Lambert's cosine, the same for all points, so that light is smooth.
        steps = (np.arange(_OCCLUSION_RAYS) + 0.5) / _OCCLUSION_RAYS
        radius, angle = np.sqrt(steps), np.arange(_OCCLUSION_RAYS) * np.pi * (3 - np.sqrt(5))
        open_share = np.zeros(len(points))
        for x, y, z in zip(radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - steps), strict=True):
            hits = cast(blockers, points, x * tangent + y * across + z * normals)
            open_share += 1 - np.exp(-hits.depth_m / _OCCLUSION_M)
        light: _Floats = _AMBIENT * (open_share / _OCCLUSION_RAYS)[:, None] * np.array([0.95, 0.98, 1.0])
        for lamp, colour in zip(self._flat.lamps, self._lamp_colour, strict=True):
            for offset in rng.permutation(_SPHERE) * _LAMP_RADIUS_M:
                towards = lamp + offset * [1, 1, 0.2] - points
                distance_m = np.linalg.norm(towards, axis=-1)
                direction = towards / distance_m[:, None]
                facing = np.maximum(np.einsum("pk,pk->p", direction, normals), 0.0)
                near = np.flatnonzero(facing > 0)
                hits = cast(blockers, points[near], direction[near])
                seen = near[hits.depth_m > distance_m[near] - 0.02]
                received = _LAMP_POWER * facing[seen] / (distance_m[seen] ** 2 + 0.4) / len(_SPHERE)
                light[seen] += received[:, None] * colour
        return light

    @property
    def _without_lamps(self) -> Surfaces:
        keep = self._surfaces.kind != Kind.LAMP
        return Surfaces(**{name: part[keep] for name, part in vars(self._surfaces).items()})

    def _albedo(self, surface: _Integers, place: _Floats, points: _Floats) -> _Floats:
        """(ray, 3) colours of surfaces, by their textures."""
        surfaces = self._surfaces
        colours = np.ones((len(surface), 3))
        kinds, metres = surfaces.kind[surface], place * surfaces.size_m[surface]
        styles = surfaces.style[surface]
        painters: dict[Kind, Callable[[_Spots], _Floats]] = {
            Kind.FLOOR: self._floor,
            Kind.CEILING: _ceiling,
            Kind.WALL: self._wall,
            Kind.WOOD: _wood,
            Kind.FABRIC: _fabric,
            Kind.BOOKS: _books,
            Kind.PICTURE: _painting,
            Kind.CARPET: _carpet,
        }
        for kind, paint in painters.items():
            here = np.flatnonzero(kinds == kind)
            if len(here):
                colours[here] = paint(_Spots(points[here], metres[here], styles[here], place[here]))
        return colours

    def _floor(self, at: _Spots) -> _Floats:
        """Boards in rooms of even numbers, tiles in the others."""
        rooms = self._flat.room_of(_above(at.points))
        row = np.floor(at.points[:, 1] / 0.14)
        board = row * 57 + np.floor(at.points[:, 0] / 1.1 + _noise(row, 3))
        grain = 0.04 * np.sin(at.points[:, 1] * 160 + 6 * np.sin(at.points[:, 0] * 3 + board))
        boards = self._wood[rooms] * (0.85 + 0.4 * _noise(board, 5) + grain)[:, None]
        tile = np.floor(at.points[:, :2] / 0.33)
        dark = ((tile.sum(axis=1) % 2) > 0).astype(float)
        tiles = (
            np.array([0.8, 0.78, 0.73]) * (1 - 0.55 * dark + 0.08 * _noise(tile[:, 0] * 31 + tile[:, 1], 7))[:, None]
        )
        return np.asarray(np.where((rooms % 2 == 0)[:, None], boards, tiles))

    def _wall(self, at: _Spots) -> _Floats:
        """Paint, with stripes in every second room, and a skirting board."""
        rooms = self._flat.room_of(_above(at.points))
        colour = self._paint[rooms] * (1 + 0.03 * np.sin(5 * at.points[:, 0] + 3 * at.points[:, 2]))[:, None]
        stripe = (np.sin(2 * np.pi * at.metres[:, 0] / 0.45) > 0.2) & (rooms % 2 == 1)
        colour = colour * np.where(stripe, 0.78, 1.0)[:, None]
        return np.asarray(np.where((at.points[:, 2] < 0.12)[:, None], [[0.85, 0.84, 0.8]], colour))


_SPHERE = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -1], [0.6, 0.6, 0], [-0.6, -0.6, 0]], float)


def _above(points: _Floats) -> _Floats:
    """The points (point, 3) moved to a height that lies within every room, so that `Flat.room_of` finds the rooms of
    floors, too."""
    return np.concatenate([points[:, :2], np.full((len(points), 1), 0.1)], axis=1)


def _noise(number: npt.NDArray[np.generic], salt: int) -> _Floats:
    """Values from 0 to 1 that look random. They are the same for the same number and `salt`."""
    mixed = np.sin(np.asarray(number, float) * 12.9898 + salt * 78.233) * 43758.5453
    return np.asarray(mixed - np.floor(mixed))


def _colour(styles: npt.NDArray[np.generic], low: float, high: float) -> _Floats:
    return np.stack([low + (high - low) * _noise(np.asarray(styles) % 9973, salt) for salt in (1, 2, 3)], axis=-1)


def _ceiling(at: _Spots) -> _Floats:
    seam = np.minimum(np.abs(at.points[:, 0] % 1.25 - 0.62), np.abs(at.points[:, 1] % 1.25 - 0.62)) < 0.02
    return np.asarray(np.where(seam, 0.78, 0.92)[:, None] * np.ones(3))


def _wood(at: _Spots) -> _Floats:
    tone = np.array([0.62, 0.42, 0.27]) * (0.6 + 0.8 * _noise(at.styles % 9973, 4))[:, None]
    grain = 0.1 * np.sin(at.metres[:, 0] * 60 + 4 * np.sin(at.metres[:, 1] * 2.5))
    door = np.abs(at.metres[:, 0] % 0.65 - 0.65) < 0.012
    return np.asarray(tone * (1 + grain - 0.5 * door)[:, None])


def _fabric(at: _Spots) -> _Floats:
    base, other = _colour(at.styles, 0.2, 0.9), _colour(at.styles + 17, 0.3, 0.95)
    check = np.sin(at.metres[:, 0] * 28) * np.sin(at.metres[:, 1] * 28) > 0.15
    return np.asarray(np.where(check[:, None], 0.75 * base + 0.25 * other, base))


def _books(at: _Spots) -> _Floats:
    shelf = np.floor(at.metres[:, 1] / 0.35)
    book = np.floor(at.metres[:, 0] / 0.06) + 101 * shelf
    tall = 0.2 + 0.12 * _noise(book + at.styles % 997, 8)
    colour = _colour((book * 7 + at.styles % 997).astype(np.int64), 0.12, 0.85)
    level = at.metres[:, 1] - 0.35 * shelf
    board, gap = level < 0.03, level > tall
    return np.asarray(
        np.where(board[:, None], [[0.5, 0.36, 0.24]], np.where(gap[:, None], [[0.12, 0.09, 0.07]], colour))
    )


def _painting(at: _Spots) -> _Floats:
    frame = np.abs(at.place - 0.5).max(axis=1) > 0.45
    x, y = at.place[:, 0], at.place[:, 1]
    wave = 0.5 + 0.25 * np.sin(7 * x + at.styles % 7) + 0.1 * np.sin(17 * x)
    sun = np.hypot(x - 0.2 - 0.6 * _noise(at.styles % 9973, 6), y - 0.7) < 0.14
    sky, land, disc = (
        _colour(at.styles + salt, low, high) for salt, low, high in ((3, 0.5, 1), (5, 0.05, 0.6), (9, 0.6, 1))
    )
    inner = np.where((y < wave * 0.8)[:, None], land, np.where(sun[:, None], disc, sky))
    return np.asarray(np.where(frame[:, None], [[0.2, 0.15, 0.1]], inner))


def _carpet(at: _Spots) -> _Floats:
    base, other = _colour(at.styles, 0.25, 0.8), _colour(at.styles + 29, 0.3, 0.95)
    edge = np.abs(at.place - 0.5).max(axis=1)
    diamond = (np.abs(at.metres[:, 0] % 0.5 - 0.25) + np.abs(at.metres[:, 1] % 0.5 - 0.25)) < 0.2
    pattern = diamond & (edge < 0.42) | (edge > 0.42) & (edge < 0.46)
    return np.asarray(np.where(pattern[:, None], other, base))
