"""Loudness maps side by side, as in the paper's figure: simulated on a grid, predicted by the field, and interpolated
between the training listeners, plain or coded.

The level is energy per ear, averaged over ears and two opposite head orientations, in dB relative to the emitter's free
field at one metre, as in `server.responses.loudness`. Grids are (row, column), row 0 the southernmost, NaN outside the
room. Metres.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from server.acoustics.decibels import power_to_db
from server.field.field import AcousticField
from server.rendering.hrtf import kemar
from server.responses.full_response import FullResponse
from server.responses.loudness import LoudnessMap, loudness_map
from training.baselines.baselines import TrainingPairs, barycentric
from training.baselines.coded import AudioCodec, CodedResponses
from training.baselines.held_out import EvaluationError, HeldOut, require_same_scene
from training.data.dataset import SPEED_OF_SOUND, Dataset
from training.simulation.direct_paths import DirectPaths
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]

_YAWS = np.array([0.0, np.pi])
_SEED = 30
# Closer to a wall, a receiver's sphere would be too small to catch enough rays.
_CLEARANCE_M = 0.08


@dataclass(frozen=True)
class EmitterMaps:
    """The maps of one emitter by method, the simulation first, all on the grid of `grid`. `listeners` (n, 3) are the
    training listeners between which responses are interpolated; `corners` (n, 2) are the corners of the floor plan."""

    corners: _Floats
    emitter: _Floats
    listeners: _Floats
    grid: LoudnessMap
    levels_db: dict[str, _Floats]

    def errors_db(self, method: str) -> float:
        """The mean absolute error over all cells, in dB."""
        truth, *_ = self.levels_db.values()
        return float(np.nanmean(np.abs(self.levels_db[method] - truth)))


def spread_out(points: _Floats, start: _Floats, count: int) -> list[int]:
    """Indices of `count` points (point, 3): the point nearest to `start`, then always the one farthest from all chosen
    so far."""
    chosen = [int(np.argmin(np.linalg.norm(points - start, axis=-1)))]
    while len(chosen) < min(count, len(points)):
        nearest = np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(axis=1)
        chosen.append(int(np.argmax(nearest)))
    return chosen


def map_emitters(
    held_out: HeldOut,
    field: AcousticField,
    *,
    emitters: int,
    spacing_m: float,
    codecs: Sequence[AudioCodec] = (),
    track: Callable[[Sequence[int], str], Iterable[int]] = lambda steps, _: steps,
) -> list[EmitterMaps]:
    """Make the maps of `emitters` probes as emitters. Responses are interpolated as they are, and coded by each of
    `codecs`. Raises EvaluationError for measured data, whose walls are
    unknown, and DatasetError if the field is of another scene."""
    dataset = held_out.simulated
    if dataset is None:
        raise EvaluationError(f"{held_out.name}: maps need a simulated scene, whose walls are known")
    require_same_scene(field.bundle, dataset)
    whole = FullResponse.through_kemar(field)
    start = dataset.scene.start
    chosen = spread_out(dataset.probes, np.array(start.emitter), emitters)
    stored = {"": held_out.pairs} | {
        f"{codec.name}-": replace(held_out.pairs, responses=CodedResponses(codec, held_out, track=track))
        for codec in codecs
    }
    return [
        _maps(stored, held_out.yaws, dataset, whole, emitter, listener_height_m=start.listener[2], spacing_m=spacing_m)
        for emitter in track(chosen, "mapping")
    ]


def _maps(
    stored: Mapping[str, TrainingPairs],
    yaws: _Floats,
    dataset: Dataset,
    whole: FullResponse,
    emitter: int,
    *,
    listener_height_m: float,
    spacing_m: float,
) -> EmitterMaps:
    position = dataset.probes[emitter]
    x, y, z = (float(coordinate) for coordinate in position)
    grid = loudness_map(whole, (x, y, z), listener_height_m=listener_height_m, spacing_m=spacing_m)
    rows, columns = grid.levels_db.shape
    across = np.meshgrid(grid.origin[0] + spacing_m * np.arange(columns), grid.origin[1] + spacing_m * np.arange(rows))
    cells = np.stack([*across, np.full((rows, columns), listener_height_m)], axis=-1)
    inside = ~np.isnan(grid.levels_db) & (dataset.plan.wall_distance_m(cells) >= _CLEARANCE_M)

    def on_grid(power: _Floats) -> _Floats:
        levels = np.full(inside.shape, np.nan)
        levels[inside] = power_to_db(power)
        return levels

    interpolated: dict[str, _Floats] = {}
    for prefix, pairs in stored.items():
        listeners, gram = _training_gram(pairs, yaws, emitter)
        nearest, linear = _interpolated_power(listeners, gram, cells[inside])
        interpolated |= {f"{prefix}nearest": on_grid(nearest), f"{prefix}linear": on_grid(linear)}
    return EmitterMaps(
        np.asarray(dataset.plan.corners),
        position,
        listeners,
        grid,
        {
            "simulation": on_grid(_simulated_power(dataset, position, cells[inside])),
            "field": np.where(inside, grid.levels_db, np.nan),
            **interpolated,
        },
    )


def _training_gram(pairs: TrainingPairs, yaws: _Floats, emitter: int) -> tuple[_Floats, _Floats]:
    """The training listeners (n, 3) of this emitter, and the dot products (n, n) of their waveforms, per ear. The
    energy of any weighted sum of the waveforms follows from them."""
    known = np.flatnonzero(pairs.training & (pairs.pair_emitter == emitter))
    opposite = [int(np.argmin(np.abs(np.angle(np.exp(1j * (yaws - yaw)))))) for yaw in _YAWS]
    waves = np.stack([pairs.response(int(pair))[opposite] for pair in known]).reshape(len(known), -1)
    ears = len(_YAWS) * 2
    return pairs.listener_positions[pairs.pair_listener[known]], (waves @ waves.T).astype(np.float64) / ears


def _interpolated_power(listeners: _Floats, gram: _Floats, cells: _Floats) -> tuple[_Floats, _Floats]:
    """(cell,) energies of two baselines: the nearest listener's waveform, and waveforms interpolated linearly in the
    horizontal plane (outside the listeners' hull: the horizontally nearest). `gram` holds the inner products of all
    waveforms."""
    nearest = np.argmin(np.linalg.norm(cells[:, None] - listeners, axis=-1), axis=-1)
    linear = np.empty(len(cells))
    for number, cell in enumerate(cells):
        around = barycentric(listeners[:, :2], cell[:2])
        if around is None:
            at = int(np.argmin(np.linalg.norm(listeners[:, :2] - cell[:2], axis=-1)))
            linear[number] = gram[at, at]
        else:
            corners, weights = around
            linear[number] = weights @ gram[np.ix_(corners, corners)] @ weights
    return gram[nearest, nearest], np.maximum(linear, 0.0)


@dataclass(frozen=True)
class Simulator:
    """Simulates whole responses at any places of a dataset's scene, as those of the dataset were simulated."""

    dataset: Dataset
    listeners: _Floats
    tracer: RoomTracer
    direct: DirectPaths
    synthesis: BinauralSynthesis

    @classmethod
    def of(cls, dataset: Dataset, listeners: _Floats, yaws: _Floats) -> "Simulator":
        directions = sphere_directions(dataset.scene.simulation.arrival_directions)
        return cls(
            dataset,
            listeners,
            RoomTracer.of(dataset.scene, dataset.effects, listeners),
            DirectPaths.of(dataset.scene, dataset.effects),
            BinauralSynthesis(kemar(dataset.sample_rate), directions, yaws, dataset.samples),
        )

    def responses(self, emitter: _Floats, rng: np.random.Generator) -> Iterator[npt.NDArray[np.floating]]:
        """Yield the responses (yaw, ear, sample) of each listener."""
        dataset, listeners = self.dataset, self.listeners
        onsets_s = dataset.plan.path_length_m(emitter, listeners) / SPEED_OF_SOUND
        arrivals = self.tracer.trace(emitter, rays=dataset.scene.simulation.rays, rng=rng)
        for listener, onset_s, arriving in zip(listeners, onsets_s, arrivals, strict=True):
            response = self.synthesis.render(arriving, listener, float(onset_s), rng)
            yield response + self.synthesis.specular(*self.direct.images(emitter, listener), listener)


def _simulated_power(dataset: Dataset, emitter: _Floats, cells: _Floats) -> _Floats:
    """(cell,) energies per ear, simulated with the dataset's number of rays."""
    rng = np.random.default_rng([dataset.seed, _SEED])
    responses = Simulator.of(dataset, cells, _YAWS).responses(emitter, rng)
    return np.array([np.square(response).sum(axis=-1).mean() for response in responses])


def draw_maps(maps: Sequence[EmitterMaps], path: Path) -> None:
    """Write a PNG with a row per emitter, a column per method and a common colour scale."""
    methods = list(maps[0].levels_db)
    walls = maps[0].corners
    width, height = np.ptp(walls, axis=0)
    across = 3.6
    figure = Figure(
        figsize=(across * len(methods) + 1.2, len(maps) * (across * height / width + 0.55) + 0.5),
        layout="constrained",
        facecolor="white",
    )
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(maps), len(methods), squeeze=False, sharex=True, sharey=True)
    simulated = np.concatenate([of_emitter.levels_db["simulation"].ravel() for of_emitter in maps])
    quietest, loudest = np.nanpercentile(simulated, (1, 99))
    image = None
    for row, (axes_of_row, of_emitter) in enumerate(zip(panels, maps, strict=True)):
        for axes, method in zip(axes_of_row, methods, strict=True):
            image = _draw_map(axes, of_emitter, method, walls, (float(quietest), float(loudest)))
            error = "" if method == "simulation" else f", off by {of_emitter.errors_db(method):.1f} dB"
            axes.set_title(f"{method}{error}", fontsize=11)
            if row == len(maps) - 1:
                axes.set_xlabel("east (m)")
        axes_of_row[0].set_ylabel("north (m)")
    assert image is not None
    bar = figure.colorbar(image, ax=panels, shrink=0.8, pad=0.01, extend="both")
    bar.set_label("level (dB re free field at 1 m)")
    figure.savefig(path, dpi=110)


def _draw_map(axes: Axes, maps: EmitterMaps, method: str, walls: _Floats, limits_db: tuple[float, float]) -> AxesImage:
    grid, levels = maps.grid, maps.levels_db[method]
    half = grid.spacing_m / 2
    rows, columns = levels.shape
    x, y = grid.origin
    extent = (x - half, x + (columns - 0.5) * grid.spacing_m, y - half, y + (rows - 0.5) * grid.spacing_m)
    image = axes.imshow(
        levels, origin="lower", extent=extent, vmin=limits_db[0], vmax=limits_db[1], cmap="viridis", aspect="equal"
    )
    closed = np.concatenate([walls, walls[:1]])
    axes.plot(*closed.T, color="black", linewidth=2.0, solid_joinstyle="miter")
    if method.endswith(("nearest", "linear")):
        axes.plot(*maps.listeners[:, :2].T, ".", color="white", markersize=4, markeredgewidth=0)
    axes.plot(*maps.emitter[:2], marker="*", color="#ff3b30", markeredgecolor="white", markersize=15, linestyle="none")
    low, high = walls.min(axis=0) - 0.2, walls.max(axis=0) + 0.2
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return image
