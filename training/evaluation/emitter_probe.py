"""The probe of walls by the protocol of Luo et al. (NeurIPS 2022): the distance from the *emitter* to the nearest wall,
decoded linearly from what a `naf` hides, with two controls: a network of the same kind that nobody trained, and MFCC of
true responses.

A place is an emitter. Its features are those of the responses at five fixed listeners, one after another. Features of
one response are the input of the network's last layer, averaged over ear, time and frequency; MFCC are averaged over
ear and time. The reader is fitted at places drawn at random in the room, a tenth as many as the cells of the grid on
which it is tested. `naf` is told positions alone; fields of ours are also told what lies around a place, so that this
probe would say little of what they learned.

Two things are less than the paper's: features are averaged over some points of time and frequency, the same of every
response, not all; and the reader is a ridge regression in place of a layer that descends for 50,000 steps.

Axes: places (place, 3), metres; features (place, feature).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from sklearn.manifold import TSNE
from sklearn.preprocessing import StandardScaler

from server.acoustics.geometry import FloorPlan
from training.baselines.held_out import EvaluationError
from training.data.dataset import Dataset
from training.evaluation.decoding import RidgeRegression
from training.evaluation.maps import Simulator, spread_out
from training.evaluation.mfcc import mfcc
from training.learning.kinds import learner_of
from training.learning.naf import NafLearner
from training.learning.runs import Configuration
from training.learning.train import load_learner
from training.models.naf import Naf
from training.simulation.responses import SimulatedResponses, open_responses

_Floats = npt.NDArray[np.float64]


class Track(Protocol):
    """May show the progress of a loop."""

    def __call__(self, steps: Sequence[int], doing: str) -> Iterable[int]: ...


LISTENERS = 5
FITTED_SHARE = 0.1
TRAINED, UNTRAINED, MFCC = "naf", "untrained naf", "MFCC"
_YAW = 0.0
_CLEARANCE_M = 0.08  # closer to a wall, a receiver would catch too few rays
_BATCH = 32
_PERPLEXITY = 30.0


@dataclass(frozen=True)
class Read:
    """What was decoded from one kind of features on the grid. explained: share of the variance of the true distance
    that it explains (offset left out, as in the paper's score). colours: (cell, 3) t-SNE of the features, 0 to 1; None
    for too few cells."""

    distance_m: _Floats
    explained: float
    mean_error_m: float
    colours: _Floats | None


@dataclass(frozen=True)
class EmitterProbe:
    """The result. cells: (cell, 3) places of the grid; fitted: the number of places that readers were fitted at."""

    run: str
    plan: FloorPlan
    listeners: _Floats
    cells: _Floats
    spacing_m: float
    fitted: int
    points: int
    true_m: _Floats
    reads: Mapping[str, Read]

    def to_json(self) -> dict[str, object]:
        return {
            "run": self.run,
            "listeners": len(self.listeners),
            "cells": len(self.cells),
            "spacing_m": self.spacing_m,
            "fitted_places": self.fitted,
            "points": self.points,
            "explained_variance": {name: read.explained for name, read in self.reads.items()},
            "mean_error_m": {name: read.mean_error_m for name, read in self.reads.items()},
        }


def _untold(steps: Sequence[int], doing: str) -> Iterable[int]:
    del doing
    return steps


def probe_emitters(
    run: Path,
    data: Path,
    *,
    spacing_m: float = 0.1,
    points: int = 256,
    seed: int = 0,
    track: Track = _untold,
) -> EmitterProbe:
    """Probe the `naf` of a finished run on a simulated dataset.

    Raises EvaluationError for measured data, another field or a room with too few cells, and RunError for a run that is
    unfinished or of other data.
    """
    responses = open_responses(data)
    if not isinstance(responses, SimulatedResponses):
        raise EvaluationError(f"{data}: a probe needs a simulated scene, whose walls are known")
    dataset = responses.dataset
    trained = load_learner(responses, run)
    if not isinstance(trained, NafLearner) or trained.field.shape.domain != "spectrogram":
        raise EvaluationError(f"{run}: holds no naf of spectrograms, whose features the paper probes")
    configuration = Configuration.read(run)
    torch.manual_seed(configuration.seed)
    untrained = learner_of(responses, configuration)
    assert isinstance(untrained, NafLearner)

    height_m = float(np.median(dataset.probes[:, 2]))
    cells = _grid(dataset.plan, spacing_m, height_m)
    fitted = _scattered(dataset.plan, round(FITTED_SHARE * len(cells)), height_m, np.random.default_rng([seed, 16]))
    if len(fitted) <= LISTENERS:
        raise EvaluationError(f"{data}: {len(cells)} cells of {spacing_m:g} m are too few to fit at a tenth as many")
    listeners = dataset.probes[spread_out(dataset.probes, np.array(dataset.scene.start.listener), LISTENERS)]
    places = np.concatenate([fitted, cells])
    distance_m = dataset.plan.wall_distance_m(places)
    features = {
        name: hidden_features(learner.field, places, listeners, points, seed, partial(track, doing=f"probing {name}"))
        for name, learner in ((TRAINED, trained), (UNTRAINED, untrained))
    }
    features[MFCC] = _coefficients(dataset, places, listeners, partial(track, doing="simulating for MFCC"))
    return EmitterProbe(
        Path(run).resolve().name,
        dataset.plan,
        listeners,
        cells,
        spacing_m,
        len(fitted),
        points,
        distance_m[len(fitted) :],
        {name: _read(values, distance_m, len(fitted), seed) for name, values in features.items()},
    )


def explained_variance(true: _Floats, predicted: _Floats) -> float:
    """The share of the variance of `true` that is gone from the difference; 1 at best."""
    return float(1.0 - np.var(true - predicted) / np.var(true))


def hidden_features(
    field: Naf,
    emitters: _Floats,
    listeners: _Floats,
    points: int,
    seed: int,
    track: Callable[[Sequence[int]], Iterable[int]] = lambda steps: steps,
) -> _Floats:
    """(emitter, listener * width) inputs of the network's last layer, averaged over both ears and `points` bins of the
    spectrogram, which are drawn once for all."""
    rng = np.random.default_rng([seed, 17])
    drawn = [torch.from_numpy(rng.integers(0, size, points)) for size in field.axes]
    rows: list[_Floats] = []
    with torch.no_grad():
        tables = [
            [table[index] for table, index in zip(field.tables(layer), drawn, strict=True)] for layer in field.entries
        ]
        of_points = [torch.stack(of_layer).sum(dim=0) for of_layer in tables]
        for start in track(range(0, len(emitters), _BATCH)):
            some = torch.from_numpy(emitters[start : start + _BATCH].astype(np.float32))
            parts = []
            for listener in listeners.astype(np.float32):
                pose = field.pose_features(torch.from_numpy(listener).expand(len(some), 3), some)
                first, skipped = (
                    field.of_pose(layer, pose)[:, None] + of_layer
                    for layer, of_layer in zip(field.entries, of_points, strict=True)
                )
                orientation = field.orientations(torch.full((len(some),), _YAW))
                parts.append(field.trunk(first, skipped, orientation, field.inner).mean(dim=(1, 2)))
            rows.append(torch.cat(parts, dim=1).numpy().astype(np.float64))
    return np.concatenate(rows)


def _coefficients(
    dataset: Dataset, emitters: _Floats, listeners: _Floats, track: Callable[[Sequence[int]], Iterable[int]]
) -> _Floats:
    """(emitter, listener * coefficient) MFCC of newly simulated responses, averaged over ears and frames."""
    simulator = Simulator.of(dataset, listeners, np.array([_YAW]))
    rows = []
    for number in track(range(len(emitters))):
        responses = simulator.responses(emitters[number], np.random.default_rng([dataset.seed, 18, number]))
        rows.append(np.concatenate([mfcc(one, dataset.sample_rate).mean(axis=(0, 1, 3)) for one in responses]))
    return np.stack(rows)


def _read(features: _Floats, distance_m: _Floats, fitted: int, seed: int) -> Read:
    reader = RidgeRegression.fit(features[:fitted], distance_m[:fitted])
    on_grid, true = features[fitted:], distance_m[fitted:]
    predicted = reader.predict(on_grid)
    colours = None
    if len(on_grid) > 2 * _PERPLEXITY:
        embedding = TSNE(n_components=3, perplexity=_PERPLEXITY, random_state=seed)
        reduced = embedding.fit_transform(StandardScaler().fit_transform(on_grid))
        low, high = reduced.min(axis=0), reduced.max(axis=0)
        colours = (reduced - low) / np.maximum(high - low, 1e-9)
    return Read(predicted, explained_variance(true, predicted), float(np.abs(predicted - true).mean()), colours)


def _grid(plan: FloorPlan, spacing_m: float, height_m: float) -> _Floats:
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    x, y = (np.arange(a + spacing_m / 2, b, spacing_m) for a, b in zip(low, high, strict=True))
    return _inside(plan, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), height_m)


def _scattered(plan: FloorPlan, count: int, height_m: float, rng: np.random.Generator) -> _Floats:
    """`count` places at random in the room."""
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    found = np.empty((0, 3))
    while len(found) < count:
        found = np.concatenate([found, _inside(plan, rng.uniform(low, high, (count, 2)), height_m)])
    return found[:count]


def _inside(plan: FloorPlan, places: _Floats, height_m: float) -> _Floats:
    raised = np.concatenate([places, np.full((len(places), 1), height_m)], axis=-1)
    clear = plan.contains(raised)
    clear[clear] = plan.wall_distance_m(raised[clear]) >= _CLEARANCE_M
    return raised[clear]
