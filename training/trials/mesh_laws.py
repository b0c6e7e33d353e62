"""Rays and paths in triangle meshes against laws that do not depend on the simulation: the free field, reciprocity,
conservation of energy, openings and walls between rooms, Eyring's formula, and diffraction at an edge.

Levels are those of the energy of all bands together: materials are the same in all octave bands. Every number comes
from several runs; `error` is the standard error of their mean.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import amplitude_to_db, db_to_power, power_to_db
from server.acoustics.mesh_paths import MeshPathFinder
from server.acoustics.mesh_tree import MeshTree
from server.acoustics.surroundings import MeshSurroundings
from server.scene.mesh_geometry import MeshGeometry
from training.data.dataset import SPEED_OF_SOUND
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.simulation.direct_paths import DirectPaths
from training.simulation.mesh_rays import MeshRayTracer
from training.simulation.rays import sphere_directions
from training.trials.edge_theories import MAEKAWA_LOSS_DB, hidden_places, uniform_theory
from training.trials.mesh_rooms import CUBE, ROUGH, house, material, place_of, places_in, two_rooms
from training.trials.reverberation import reverberation_time_s

_Floats = npt.NDArray[np.float64]

_BANDS: Final = len(OCTAVE_BANDS_HZ)
_HALF_PLANE: Final = 2.0
"""The air around the end of a thin wall, in half turns."""
_CHART_HZ: Final = 8000.0
_CHART_M: Final = 20.0
"""How far the two ends are from the screen: so far that the bent path is hardly longer than the straight one, by which
the chart counts."""


@dataclass(frozen=True)
class Sizes:
    """How much is traced. `runs` have random numbers of their own."""

    rays: int = 12_000
    runs: int = 4
    receivers: int = 24
    pairs: int = 8
    free_paths: int = 100_000
    edges: int = 200


@dataclass(frozen=True)
class Deviation:
    """How far what was measured is from what a law says, in dB."""

    law: str
    place: str
    size: str
    off_db: float
    error_db: float


@dataclass(frozen=True)
class Reciprocity:
    """Mean absolute differences over pairs and octave bands, in dB: of runs in both directions, and of two runs in one
    of them."""

    place: str
    pairs: int
    rays: int
    there_and_back_db: float
    twice_db: float


@dataclass(frozen=True)
class Decay:
    """The reverberation time of a room, and Eyring's. `eyring_of_paths_s` takes into account that free paths differ in
    length (Kuttruff, Room Acoustics, 5.3), by their relative variance, which is measured with straight lines."""

    place: str
    volume_m3: float
    surface_m2: float
    absorption: float
    eyring_s: float
    eyring_of_paths_s: float
    found_s: float
    error_s: float


@dataclass(frozen=True)
class Slit:
    """Levels of a room beside that of the emitter, into which sound comes by a slit of this area, in dB."""

    area_m2: float
    expected_db: float
    found_db: float
    error_db: float


@dataclass(frozen=True)
class Screened:
    """The loss at the edge of a screen, in dB, by Fresnel number: in a mesh, measured by Maekawa, and of an infinite
    half-plane that reflects everything or nothing (None in sight, where theory has more than the edge's wave)."""

    fresnel_number: float
    found_db: float
    chart_db: float
    rigid_db: float | None
    absorbing_db: float | None


@dataclass(frozen=True)
class ScreenedPlaces:
    """Losses in a mesh less those of theory, in dB, over random pairs that a half-plane hides, in all octave bands:
    mean, and the quantiles of 5 % and 95 %."""

    pairs: int
    reflecting: bool
    mean_db: float
    low_db: float
    high_db: float


def direct_sound(sizes: Sizes, rng: np.random.Generator) -> Deviation:
    """Above open ground, 0.5 to 200 m apart."""
    ground = place_of((CUBE[:4] * (1000, 1000, 0) - (500, 500, 0), [(0, 1, 3), (0, 3, 2)], ROUGH), rough=material(0, 0))
    surroundings = MeshSurroundings(ground.mesh, open_sky=True)
    paths = DirectPaths(surroundings, None, surroundings.sound_paths(SPEED_OF_SOUND), None)
    shares = []
    distances = np.geomspace(0.5, 200, sizes.pairs)
    for distance in distances:
        emitter = np.array((0.0, 0.0, rng.uniform(1, 3)))
        turn = rng.uniform(0, 2 * np.pi)
        listener = emitter + distance * np.array((np.cos(turn), np.sin(turn), 0.0))
        _, amplitudes = paths.images(emitter, listener)
        shares.append(float(np.sum(amplitudes**2, axis=0).mean() * distance**2))
    size = f"{len(distances)} pairs, 0.5 to 200 m"
    return _deviation("direct sound: 1 / d² in all bands", "open ground", size, shares)


def mirrored_by_a_slope(sizes: Sizes, rng: np.random.Generator) -> Deviation:
    """All else is air: what the slope leaves, over the square of the distance from the image."""
    corners = np.array([(-30, -30, 15), (30, -30, -15), (30, 30, -15), (-30, 30, 15)], dtype=float)
    slope = place_of((corners, [(0, 1, 2), (0, 2, 3)], ROUGH), rough=material(0.36, 0.0))
    normal = slope.mesh.normals[0]
    emitter = np.array((0.3, 0.1, 2.0))
    image = emitter - 2 * (emitter @ normal) * normal
    receivers = rng.uniform((-4, -4, 3), (4, 4, 5), (sizes.receivers, 3))
    square = np.sum((receivers - image) ** 2, axis=-1)

    def share(run_rng: np.random.Generator) -> float:
        energy = _traced(slope, emitter, receivers, sizes.rays * 4, run_rng, duration_s=0.1)
        return float(np.mean(energy.sum(axis=-1) * square / 0.64))

    return _of_runs("a mirrored wave: (1 - a) / d² from its image", "a slope", sizes, rng, share, rays=sizes.rays * 4)


def kept_energy(sizes: Sizes, rng: np.random.Generator, scattering: float) -> Deviation:
    """What is radiated within a bin stays, and fills the room evenly: 4 pi c dt / V."""
    place, duration_s = house(0.0, scattering), 2.0
    emitter, *receivers = places_in(place, sizes.receivers + 1, rng)
    expected = 4 * np.pi * SPEED_OF_SOUND * HISTOGRAM_BIN_S / place.mesh.volume_m3

    def share(run_rng: np.random.Generator) -> float:
        energy = _traced(place, emitter, np.array(receivers), sizes.rays // 4, run_rng, duration_s=duration_s)
        return float(energy[:, energy.shape[-1] // 2 :].mean() / expected)

    law = f"nothing absorbs: after 1 to {duration_s:g} s, all that was sent is there (s = {scattering:g})"
    return _of_runs(law, "gabled house", sizes, rng, share, rays=sizes.rays // 4)


def kept_behind_a_wall(sizes: Sizes, rng: np.random.Generator) -> Deviation:
    """All that a sheet between two rooms absorbs goes through, and the other walls absorb nothing. What enters a thick
    wall at its edge would leave it outside of the rooms."""
    place = two_rooms(wall_m=0.0, absorption=0.0, panel=material(0.3, 0.4))
    places = np.concatenate(_in_two_rooms(sizes.receivers, 0.0, rng))
    volumes_m3, rays = np.array([3 * 3 * 2.5, 4 * 3 * 2.5]), sizes.rays // 2
    # Later on, where nothing is lost, few rays bring most of the energy.
    begins, ends_s = round(0.1 / HISTOGRAM_BIN_S), 0.4
    losses_db = _losses_db(-float(power_to_db(0.3)))

    def share(run_rng: np.random.Generator) -> float:
        energy = _traced(place, _SENT_FROM, places, rays, run_rng, duration_s=ends_s, losses_db=losses_db)
        late = energy[:, begins:].reshape(2, -1).mean(axis=-1)
        return float(late @ volumes_m3 / (4 * np.pi * SPEED_OF_SOUND * HISTOGRAM_BIN_S))

    law = "what a wall lets through is not lost: after 0.1 to 0.4 s, all that was sent is in both rooms"
    return _of_runs(law, "two rooms", sizes, rng, share, rays=rays)


def steady_state(sizes: Sizes, rng: np.random.Generator, absorption: float) -> Deviation:
    """As much is absorbed as is sent: the reflected power of a diffuse field is 16 pi (1 - a) / (S a) (Kuttruff,
    5.5)."""
    place, many = house(absorption, 1.0), replace(sizes, receivers=5 * sizes.receivers)
    surface_m2 = float(place.mesh.areas_m2.sum())
    expected = 16 * np.pi * (1 - absorption) / (surface_m2 * absorption)
    duration_s = 1.2 * _eyring_s(place.mesh.volume_m3, surface_m2, absorption)

    def share(run_rng: np.random.Generator) -> float:
        emitter, *receivers = places_in(place, many.receivers + 1, run_rng)
        energy = _traced(place, emitter, np.array(receivers), sizes.rays, run_rng, duration_s=duration_s)
        return float(energy.sum(axis=-1).mean() / expected)

    law = f"as much is absorbed as is sent: 16 π (1 - a) / (S a) (a = {absorption:g})"
    return _of_runs(law, "gabled house", many, rng, share)


def behind_a_wall(sizes: Sizes, rng: np.random.Generator, loss_db: float) -> Deviation:
    """Levels of two rooms differ by the transmission loss and 10 lg(A / S) of the receiving one."""
    absorption, wall_m2 = 0.06, 3 * 2.5
    place = two_rooms(wall_m=0.02, absorption=absorption, panel=material(0.08, 1.0))
    absorbed_m2 = absorption * (2 * (4 * 3 + 4 * 2.5) + wall_m2) + 0.08 * wall_m2
    expected_db = loss_db + float(power_to_db(absorbed_m2 / wall_m2))

    rays = sizes.rays // 8  # there are many walls to go through, and rays for all of them

    def share(run_rng: np.random.Generator) -> float:
        places = _in_two_rooms(sizes.receivers, 0.02, run_rng)
        here, there = _levels_db(place, places, rays, run_rng, _losses_db(loss_db))
        return float(db_to_power(here - there - expected_db))

    law = f"behind a wall: TL + 10 lg(A / S) (TL = {loss_db:g} dB)"
    return _of_runs(law, "two rooms", sizes, rng, share, rays=rays)


def there_and_back(sizes: Sizes, rng: np.random.Generator) -> Reciprocity:
    place = house(0.2, 0.5)
    return _there_and_back("gabled house", place, places_in(place, 2 * sizes.pairs, rng), sizes.rays // 2, rng)


def from_room_to_room_and_back(sizes: Sizes, rng: np.random.Generator) -> Reciprocity:
    """With other materials in other bands, through a doorway for many of the pairs."""
    place = MeshGeometry.of_plan(SceneFile.read(_APARTMENT).geometry)
    return _there_and_back("apartment", place, places_in(place, 2 * sizes.pairs, rng), sizes.rays // 2, rng)


def through_a_wall_and_back(sizes: Sizes, rng: np.random.Generator) -> Reciprocity:
    place = two_rooms(wall_m=0.1, absorption=0.1, panel=material(0.2, 0.3), lining=material(0.1, 0.6))
    ends = np.stack(_in_two_rooms(sizes.pairs, 0.1, rng), axis=1).reshape(-1, 3)
    return _there_and_back("through a wall of 20 dB", place, ends, sizes.rays // 8, rng, losses_db=_losses_db(20.0))


def _there_and_back(
    name: str,
    place: MeshGeometry,
    ends: _Floats,
    rays: int,
    rng: np.random.Generator,
    *,
    losses_db: _Floats | None = None,
) -> Reciprocity:
    """Compare the energies in each octave band between pairs of places, two rows of `ends` each, when the two change
    places."""

    def levels_db(emitter: _Floats, receiver: _Floats) -> _Floats:
        energy = _by_band(place, emitter, receiver[None], rays, rng, duration_s=0.6, losses_db=losses_db)
        return power_to_db(energy[0].sum(axis=-1))

    back_db, twice_db = [], []
    for one, other in ends.reshape(-1, 2, 3):
        there, back = ([levels_db(*ends) for _ in range(2)] for ends in ((one, other), (other, one)))
        back_db += [np.abs(a - b).mean() for a in there for b in back]
        twice_db += [np.abs(a - b).mean() for a, b in (there, back)]
    return Reciprocity(name, len(ends) // 2, rays, float(np.mean(back_db)), float(np.mean(twice_db)))


def decay(
    name: str, room: Callable[[float, float], MeshGeometry], absorption: float, sizes: Sizes, rng: np.random.Generator
) -> Decay:
    """Compare the reverberation time of a room whose walls scatter everything with Eyring's."""
    place = room(absorption, 1.0)
    emitter, *receivers = places_in(place, sizes.receivers + 1, rng)
    volume_m3, surface_m2 = place.mesh.volume_m3, float(place.mesh.areas_m2.sum())
    lost = -np.log(1 - absorption)
    eyring_s = _eyring_s(volume_m3, surface_m2, absorption)
    _, variance = free_paths(place, sizes.free_paths, rng)
    found_s = []
    for run_rng in rng.spawn(sizes.runs):
        energy = _traced(place, emitter, np.array(receivers), sizes.rays, run_rng, duration_s=1.2 * eyring_s)
        found_s.append(reverberation_time_s(energy.sum(axis=0)[None])[0])
    return Decay(
        name,
        volume_m3,
        surface_m2,
        absorption,
        eyring_s,
        float(eyring_s / (1 - variance / 2 * lost)),
        *_mean_and_error(found_s),
    )


def free_paths(place: MeshGeometry, count: int, rng: np.random.Generator) -> tuple[float, float]:
    """The mean and the relative variance of the lengths of straight lines that leave the surfaces by Lambert's law."""
    mesh = place.mesh
    triangle = rng.choice(len(mesh.triangles), count, p=mesh.areas_m2 / mesh.areas_m2.sum())
    shares = rng.dirichlet((1, 1, 1), count)
    starts = np.einsum("nc,ncx->nx", shares, mesh.corners_m[triangle])
    # The sum of the normal and a random unit vector is distributed by Lambert's law.
    around = rng.standard_normal((count, 3))
    ways = mesh.normals[triangle] + around / np.linalg.norm(around, axis=-1, keepdims=True)
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    lengths = MeshTree(mesh).closest(starts + 1e-6 * mesh.normals[triangle], ways).distance
    return float(lengths.mean()), float(lengths.var() / lengths.mean() ** 2)


def slit(sizes: Sizes, rng: np.random.Generator, width_m: float) -> Slit:
    """Compare the levels of two rooms with a slit between them with the balance of their energies.

    What falls on the surfaces of a room is what they reflect and what comes through the slit. With irradiations I that
    are the same everywhere in each room, areas S and S' of the rooms' surfaces, the area A of the slit, and D of the
    4 pi that the emitter sends going straight into the slit: I (a S + A) = I' A + (1 - a) (4 pi - D), and
    I' (a S' + A) = I A + (1 - a) D.
    """
    absorption, height_m = 0.1, 2.5
    place = two_rooms(wall_m=0.0, absorption=absorption, panel=material(absorption, 1.0), slit_m=width_m)
    area_m2 = width_m * height_m
    near_m2, far_m2 = (2 * (x * 3 + x * 2.5 + 3 * 2.5) - area_m2 for x in (3, 4))
    straight = _seen_through(_SENT_FROM, 3.0, ((3 - width_m) / 2, (3 + width_m) / 2), (0.0, height_m))
    balance = [[absorption * near_m2 + area_m2, -area_m2], [-area_m2, absorption * far_m2 + area_m2]]
    near, far = np.linalg.solve(balance, (1 - absorption) * np.array([4 * np.pi - straight, straight]))
    found_db = []
    for run_rng in rng.spawn(sizes.runs):
        places = _in_two_rooms(sizes.receivers, 0.0, run_rng)
        here, there = _levels_db(place, places, sizes.rays, run_rng, None)
        found_db.append(there - here)
    return Slit(area_m2, float(power_to_db(far / near)), *_mean_and_error(found_db))


def screened() -> list[Screened]:
    """The losses over the edge of a wide screen, for pairs at both sides of it, by Fresnel number."""
    finder = _over_a_screen()
    wavelength_m = SPEED_OF_SOUND / _CHART_HZ
    rows = []
    for number, chart_db in MAEKAWA_LOSS_DB.items():
        # Each of both legs is longer than half of the straight line by half of the detour.
        leg_m = _CHART_M + abs(number) * wavelength_m / 4
        below_m = np.sqrt(leg_m**2 - _CHART_M**2) * (1.0 if number >= 0 else -1.0)
        ends = np.array([(-_CHART_M, 0.0, -below_m), (_CHART_M, 0.0, -below_m)])
        paths = finder.find(ends[0], ends[1:])
        found_db = -float(paths.screen_db[0, OCTAVE_BANDS_HZ.index(_CHART_HZ)])
        theory: list[float | None] = [None, None]
        if number > 0:
            towards = np.array([np.arctan2(_CHART_M, below_m)])
            legs = np.array([leg_m])
            pairs = legs, legs, towards, 2 * np.pi - towards
            theory = [_half_plane_loss_db(_CHART_HZ, *pairs, reflecting=each) for each in (True, False)]
        rows.append(Screened(number, found_db, chart_db, *theory))
    return rows


def screened_places(sizes: Sizes, rng: np.random.Generator) -> list[ScreenedPlaces]:
    """The losses over the edge of a wide screen, for random pairs that it hides, against theory."""
    finder = _over_a_screen()
    places = hidden_places(sizes.edges, _HALF_PLANE, rng)
    # Angles are counted from the side of the screen that the emitter is on, downwards from its edge.
    before, after, towards, away = places
    emitters = np.stack([-before * np.sin(towards), np.zeros(len(before)), -before * np.cos(towards)], axis=-1)
    listeners = np.stack([-after * np.sin(away), np.zeros(len(after)), -after * np.cos(away)], axis=-1)
    found_db = np.array(
        [
            -finder.find(listener, emitter[None]).screen_db[0]
            for listener, emitter in zip(listeners, emitters, strict=True)
        ]
    )
    rows = []
    for reflecting in (True, False):
        theory = np.stack(
            [uniform_theory(hz, *places, _HALF_PLANE, reflecting=reflecting) for hz in OCTAVE_BANDS_HZ], axis=-1
        )
        off_db = found_db + amplitude_to_db(np.abs(theory))
        low_db, high_db = np.quantile(off_db, (0.05, 0.95))
        rows.append(ScreenedPlaces(len(before), reflecting, float(off_db.mean()), float(low_db), float(high_db)))
    return rows


_APARTMENT: Final = Path(__file__).parents[1] / "scenes" / "apartment.toml"
_SENT_FROM: Final = np.array([1.4, 0.8, 1.7])
"""The emitter's place in the first of two rooms."""


def _half_plane_loss_db(
    frequency: float, before: _Floats, after: _Floats, towards: _Floats, away: _Floats, *, reflecting: bool
) -> float:
    """Of one pair."""
    gain = uniform_theory(frequency, before, after, towards, away, _HALF_PLANE, reflecting=reflecting)
    return -float(amplitude_to_db(np.abs(gain))[0])


def _over_a_screen() -> MeshPathFinder:
    """Paths over a sheet of 120 x 60 m in the plane x = 0, whose upper edge is at the height 0."""
    corners = [(0, -60, -60), (0, 60, -60), (0, 60, 0), (0, -60, 0)]
    sheet = place_of((corners, [(0, 1, 2), (0, 2, 3)], ROUGH), rough=material(0, 0))
    return MeshPathFinder(MeshTree(sheet.mesh), SPEED_OF_SOUND)


def _in_two_rooms(count: int, wall_m: float, rng: np.random.Generator) -> tuple[_Floats, _Floats]:
    """`count` places in each of `two_rooms`."""
    low, high = np.full(3, 0.4), np.array([(2.6, 2.6, 2.1), (3.6, 2.6, 2.1)])
    here, there = (rng.uniform(low, end, (count, 3)) for end in high)
    return here, there + np.array((3 + wall_m, 0, 0))


def _levels_db(
    place: MeshGeometry,
    places: tuple[_Floats, _Floats],
    rays: int,
    rng: np.random.Generator,
    losses_db: _Floats | None,
) -> tuple[float, float]:
    """The levels of reflected sound in two rooms."""
    energy = _traced(place, _SENT_FROM, np.concatenate(places), rays, rng, duration_s=1.2, losses_db=losses_db)
    here, there = np.split(energy.sum(axis=-1), [len(places[0])])
    return float(power_to_db(here.mean())), float(power_to_db(there.mean()))


def _losses_db(loss_db: float) -> _Floats:
    """(material, band) of `two_rooms`: all but the wall between them is closed."""
    return np.repeat([[np.inf], [loss_db], [loss_db]], _BANDS, axis=1)


def _seen_through(
    point: _Floats, plane_x_m: float, across_m: tuple[float, float], heights_m: tuple[float, float]
) -> float:
    """The solid angle of an upright rectangle in the plane x = `plane_x_m`, as seen from a point."""
    away = plane_x_m - point[0]

    def corner(y: float, z: float) -> float:
        return float(np.arctan2(y * z, away * np.sqrt(away**2 + y**2 + z**2)))

    (left, right), (low, high) = (np.subtract(ends, at) for ends, at in ((across_m, point[1]), (heights_m, point[2])))
    return corner(right, high) - corner(left, high) - corner(right, low) + corner(left, low)


def _traced(
    place: MeshGeometry,
    emitter: _Floats,
    receivers: _Floats,
    rays: int,
    rng: np.random.Generator,
    *,
    duration_s: float,
    losses_db: _Floats | None = None,
) -> _Floats:
    """(receiver, bin) energies, the mean of all bands."""
    energy = _by_band(place, emitter, receivers, rays, rng, duration_s=duration_s, losses_db=losses_db)
    return np.asarray(energy.mean(axis=1))


def _by_band(
    place: MeshGeometry,
    emitter: _Floats,
    receivers: _Floats,
    rays: int,
    rng: np.random.Generator,
    *,
    duration_s: float,
    losses_db: _Floats | None = None,
) -> _Floats:
    """(receiver, band, bin) energies of all that is reflected."""
    tracer = MeshRayTracer(
        place,
        receivers,
        duration_s=duration_s,
        image_order=0,
        arrival_directions=sphere_directions(1),
        losses_db=losses_db,
    )
    return np.asarray(tracer.trace(emitter, rays=rays, rng=rng).sum(axis=1, dtype=np.float64))


def _of_runs(
    law: str,
    place: str,
    sizes: Sizes,
    rng: np.random.Generator,
    share: Callable[[np.random.Generator], float],
    *,
    rays: int | None = None,
) -> Deviation:
    """The deviation over runs, each with random numbers of its own, from their shares of what the law says."""
    size = f"{rays or sizes.rays:,} rays, {sizes.receivers} receivers, {sizes.runs} runs"
    return _deviation(law, place, size, [share(each) for each in rng.spawn(sizes.runs)])


def _deviation(law: str, place: str, size: str, shares: Sequence[float]) -> Deviation:
    """The mean is that of energies: a mean of levels would be too low where few rays bring much."""
    mean, error = _mean_and_error(shares)
    return Deviation(law, place, size, float(power_to_db(mean)), float(10 / np.log(10) * error / mean))


def _eyring_s(volume_m3: float, surface_m2: float, absorption: float) -> float:
    return float(-24 * np.log(10) / SPEED_OF_SOUND * volume_m3 / (surface_m2 * np.log(1 - absorption)))


def _mean_and_error(values: Sequence[npt.ArrayLike]) -> tuple[float, float]:
    """The mean, and its standard error; the latter is NaN for a single value."""
    found = np.asarray(values, np.float64)
    error = found.std(ddof=1) / np.sqrt(len(found)) if len(found) > 1 else np.nan
    return float(found.mean()), float(error)


LAWS: Final[tuple[Callable[[Sizes, np.random.Generator], Deviation], ...]] = (
    direct_sound,
    mirrored_by_a_slope,
    *(partial(kept_energy, scattering=scattering) for scattering in (0.0, 0.5, 1.0)),
    kept_behind_a_wall,
    *(partial(steady_state, absorption=absorption) for absorption in (0.1, 0.2, 0.3)),
    *(partial(behind_a_wall, loss_db=loss_db) for loss_db in (15.0, 25.0, 45.0)),
)
"""Laws of the energy of rays and of the direct sound, in the order of a table."""
RECIPROCITIES: Final[tuple[Callable[[Sizes, np.random.Generator], Reciprocity], ...]] = (
    there_and_back,
    from_room_to_room_and_back,
    through_a_wall_and_back,
)
