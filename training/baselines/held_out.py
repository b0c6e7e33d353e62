"""The held-out pairs of a dataset, simulated or measured: what each method must estimate, and the pairs that it may
use.

Axes: the responses of one pair are `(yaw, channel, sample)`, whole, with the direct sound. Metres, radians.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.acoustics.doors import Openness
from server.acoustics.geometry import Quaternion
from server.core.errors import NafirError
from server.rendering.hrtf import HeadFilters, Hrtf, kemar
from server.scene.bundle import Bundle
from training.baselines.baselines import PairResponses, TrainingPairs
from training.data.dataset import TAKES, Dataset, Half
from training.data.dataset_check import DatasetError
from training.data.levels.level_scene import LevelScene
from training.data.responses import ImportedDataset
from training.simulation.references import References
from training.simulation.responses import SimulatedResponses, open_responses

Responses = npt.NDArray[np.floating]
_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.integer]


class EvaluationError(NafirError):
    """An evaluation that is not possible."""


@dataclass(frozen=True)
class HeldOut:
    """Held-out pairs by index, counted from 0.

    pairs: all pairs of the dataset, and which of them a method may use. held_out: (index,) numbers of the held-out
    pairs among those. repeats: a second independent take of each pair, if there is one. delays_s: (pair,) seconds until
    the first sound can arrive. yaws: (yaw,) of all responses, or orientations (yaw, 4) of heads that are tilted too.
    yaw_indices: (n,) indices of the yaws that are evaluated. visible: (index,) whether the ends see each other.
    """

    folder: Path
    name: str
    sample_rate: int
    samples: int
    channels: int
    pairs: TrainingPairs
    held_out: _Integers
    repeats: PairResponses | None
    delays_s: _Floats
    yaws: _Floats
    yaw_indices: _Integers
    visible: npt.NDArray[np.bool_]
    simulated: Dataset | None
    left_out: int = 0
    """Number of pairs that are not used because they lack a response at one of the orientations."""
    filters: HeadFilters | None = None
    """The head through which the responses are heard, if it is not that of the data."""

    def openness(self, index: int) -> Openness | None:
        """How far doors are open in a pair; None where none moves."""
        if self.simulated is None or not self.simulated.doors:
            return None
        emitter = int(self.held_out[index]) // len(self.simulated.probes)
        return tuple(self.simulated.states.openness[emitter].tolist())

    def __post_init__(self) -> None:
        if not len(self.held_out):
            raise EvaluationError(f"{self.name}: no pair is held out")

    def __len__(self) -> int:
        return len(self.held_out)

    @property
    def emitters(self) -> _Floats:
        """(index, 3)"""
        return np.asarray(self.pairs.emitter_positions[self.pairs.pair_emitter[self.held_out]])

    @property
    def listeners(self) -> _Floats:
        """(index, 3)"""
        return np.asarray(self.pairs.listener_positions[self.pairs.pair_listener[self.held_out]])

    def reference(self, index: int) -> Responses:
        """The responses at the orientations that are evaluated."""
        return self.pairs.response(int(self.held_out[index]))[self.yaw_indices]

    def reheard(self, hrtf: Path | None, *, tilt_deg: float = 0.0) -> "HeldOut":
        """The same pairs heard through another head (a SOFA file), or with the head tilted up, down, to the left and to
        the right in turn.

        Raises EvaluationError for measured responses, which know one head, and HrtfError for a file that is no head.
        """
        if self.simulated is None:
            raise EvaluationError(f"{self.name}: a measurement knows one head; another is for simulated data only")
        heads = self.yaws
        if tilt_deg:
            heads = tilted(heads, math.radians(tilt_deg))
            # In turn among those that are evaluated: every fourth of all would be tilted alike.
            heads[self.yaw_indices] = tilted(self.yaws[self.yaw_indices], math.radians(tilt_deg))
        rate = self.sample_rate
        filters = kemar(rate) if hrtf is None else HeadFilters.from_hrtf(Hrtf.read(hrtf, rate))
        first, second = (References(self.simulated, take, filters=filters, heads=heads) for take in TAKES)
        told = [f"through {hrtf.stem}"] if hrtf is not None else []
        told += [f"tilted by {tilt_deg:g} degrees"] if tilt_deg else []
        return replace(
            self,
            name=", ".join([self.name, *told]),
            pairs=replace(self.pairs, responses=first),
            repeats=second,
            yaws=heads,
            filters=filters,
        )

    def of_half(self, half: Half) -> "HeldOut":
        """Those of one half of the held-out pairs. Quality levels are chosen by the other one.

        Raises EvaluationError for measured responses, by which no levels are chosen.
        """
        if self.simulated is None:
            raise EvaluationError(f"{self.name}: no levels are chosen by measured responses, so there are no halves")
        ends = self.simulated.held_out_half(half)
        kept = np.isin(self.held_out, ends[:, 0] * len(self.simulated.probes) + ends[:, 1])
        return replace(self, held_out=self.held_out[kept], visible=self.visible[kept])

    def sample(self, *, pairs: int | None, yaws: int | None, seed: int) -> "HeldOut":
        """A random subset of `pairs` pairs, and `yaws` evenly spaced orientations; all of them if there are fewer."""
        chosen = np.arange(len(self))
        if pairs is not None and pairs < len(self):
            chosen = np.sort(np.random.default_rng([seed, 11]).choice(len(self), pairs, replace=False))
        yaw_indices = self.yaw_indices
        if yaws is not None and yaws < len(yaw_indices):
            yaw_indices = yaw_indices[np.linspace(0, len(yaw_indices), yaws, endpoint=False).astype(int)]
        return replace(self, held_out=self.held_out[chosen], yaw_indices=yaw_indices, visible=self.visible[chosen])


def tilted(yaws: _Floats, angle_rad: float) -> _Floats:
    """(yaw, 4) orientations of heads at these yaws, in turn tilted up, down, to the left and to the right."""
    tilts = [(angle_rad, 0.0), (-angle_rad, 0.0), (0.0, -angle_rad), (0.0, angle_rad)]
    return np.array([Quaternion.from_angles(yaw, *tilts[number % 4]) for number, yaw in enumerate(yaws)])


@contextmanager
def open_held_out(folder: Path) -> Iterator[HeldOut]:
    """The held-out pairs of a simulated or measured dataset folder. Responses are drawn, or read from disk, when they
    are needed.

    Raises DatasetError or ResponsesError if the folder holds no dataset, and EvaluationError if no pair is held out.
    """
    responses = open_responses(folder)
    if isinstance(responses, SimulatedResponses):
        yield _of_simulation(responses.dataset)
    else:
        yield _of_measurement(responses)


def require_same_scene(bundle: Bundle, dataset: Dataset) -> None:
    """Raises DatasetError if dataset and bundle are of different scenes."""
    codec = bundle.manifest.codec.codec
    is_same = (codec.sample_rate, codec.samples) == (dataset.sample_rate, dataset.samples)
    if isinstance(dataset.place, LevelScene):
        mesh = dataset.place.mesh if dataset.doors else dataset.place.place.mesh
        is_same &= bundle.mesh is not None and bundle.mesh.to_bytes() == mesh.to_bytes()
        is_same &= tuple(door.name for door in bundle.doors) == dataset.doors
    else:
        is_same &= bundle.manifest.geometry == dataset.place.geometry
    if not is_same:
        raise DatasetError(f"{dataset.folder}: is not of the scene of {bundle.folder}")


def _of_simulation(dataset: Dataset) -> HeldOut:
    probes = dataset.probes
    emitter, listener = np.divmod(np.arange(len(probes) ** 2), len(probes))
    held_out = np.flatnonzero(dataset.held_out.ravel())
    training = dataset.trained.ravel()
    return HeldOut(
        folder=dataset.folder,
        name=f"{dataset.place.id} (simulated)",
        sample_rate=dataset.sample_rate,
        samples=dataset.samples,
        channels=2,
        pairs=TrainingPairs(References(dataset), listener, emitter, probes, probes, training),
        held_out=held_out,
        repeats=References(dataset, TAKES[1]),
        delays_s=dataset.onset_s.ravel(),
        yaws=dataset.yaws,
        yaw_indices=np.arange(len(dataset.yaws)),
        visible=dataset.is_visible(np.column_stack([emitter, listener])[held_out]),
        simulated=dataset,
    )


@dataclass(frozen=True)
class _MeasuredResponses:
    """The responses of pairs; `rows` are (pair, yaw) rows of the dataset."""

    dataset: ImportedDataset
    rows: _Integers

    def __getitem__(self, pair: int) -> npt.NDArray[np.float32]:
        return self.dataset.read(self.rows[pair])


@dataclass(frozen=True)
class MeasuredPairs:
    """The pairs of a measurement that have a response at each of the `yaws` (yaw,). `left_out` counts the other pairs.
    delays_s: (pair,) along the straight line, because the walls are unknown."""

    pairs: TrainingPairs
    delays_s: _Floats
    yaws: _Floats
    left_out: int


def measured_pairs(dataset: ImportedDataset) -> MeasuredPairs:
    """Raises EvaluationError if no pair was measured at all orientations."""
    whole_turn = np.round(2 * np.pi, 6)
    yaws, yaw_index = np.unique(np.round(dataset.yaw % (2 * np.pi), 6) % whole_turn, return_inverse=True)
    rows = np.full((int(dataset.pair.max()) + 1, len(yaws)), -1)
    rows[dataset.pair, yaw_index.reshape(-1)] = np.arange(len(dataset.pair))
    complete = (rows >= 0).all(axis=1)
    rows = rows[complete]
    if not len(rows):
        raise EvaluationError(f"{dataset.folder}: no pair was measured at all of the {len(yaws)} orientations")
    emitters, pair_emitter = unique_points(dataset.emitter[rows[:, 0]])
    listeners, pair_listener = unique_points(dataset.listener[rows[:, 0]])
    responses, training = _MeasuredResponses(dataset, rows), ~dataset.held_out[rows[:, 0]]
    pairs = TrainingPairs(responses, pair_listener, pair_emitter, listeners, emitters, training)
    return MeasuredPairs(pairs, dataset.onset_s[rows[:, 0]], yaws, int((~complete).sum()))


def _of_measurement(dataset: ImportedDataset) -> HeldOut:
    """The walls are unknown, so every pair counts as in sight."""
    measured = measured_pairs(dataset)
    held_out = np.flatnonzero(~measured.pairs.training)
    return HeldOut(
        folder=dataset.folder,
        name=f"{dataset.folder.name} (measured, {dataset.layout})",
        sample_rate=dataset.sample_rate,
        samples=dataset.samples,
        channels=dataset.channels,
        pairs=measured.pairs,
        held_out=held_out,
        repeats=None,
        delays_s=measured.delays_s,
        yaws=measured.yaws,
        yaw_indices=np.arange(len(measured.yaws)),
        visible=np.ones(len(held_out), dtype=bool),
        simulated=None,
        left_out=measured.left_out,
    )


def unique_points(positions: _Floats) -> tuple[_Floats, _Integers]:
    """The different positions (point, 3) of rows (row, 3), and the point (row,) of each."""
    points, index = np.unique(positions, axis=0, return_inverse=True)
    return points, index.reshape(-1)
