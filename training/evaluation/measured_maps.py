"""Maps of loudness at the listeners of a measurement, whose walls are unknown: measured, and by each method at the
listeners that were held out.

The level is the energy of a response, averaged over orientations and channels, in dB relative to the loudest measured
one of the same emitter. Metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from server.acoustics.decibels import power_to_db
from training.baselines.held_out import EvaluationError, HeldOut, Responses
from training.evaluation.evaluate import Column

_Floats = npt.NDArray[np.float64]

_AXES = ("x (m)", "y (m)", "z (m)")
_LEAST_DB = -80.0


@dataclass(frozen=True)
class MeasuredMaps:
    """The maps of one emitter. listeners: (n, 3); levels_db: (n,) by method, `measured` first; the others are NaN at
    listeners that training knows or where a method has no estimate."""

    emitter: _Floats
    listeners: _Floats
    levels_db: dict[str, _Floats]

    def error_db(self, method: str) -> float:
        """The mean absolute error over held-out listeners; NaN if the method estimates none."""
        difference = np.abs(self.levels_db[method] - self.levels_db["measured"])
        return float(np.nanmean(difference)) if np.isfinite(difference).any() else np.nan


def map_measured(held_out: HeldOut, columns: Sequence[Column], *, emitters: int) -> list[MeasuredMaps]:
    """Make the maps of the emitters with the most held-out listeners, up to so many of them."""
    pairs = held_out.pairs
    of_held_out = pairs.pair_emitter[held_out.held_out]
    numbers, counts = np.unique(of_held_out, return_counts=True)
    chosen = numbers[np.argsort(-counts, kind="stable")][:emitters]
    return [_map(held_out, columns, int(emitter)) for emitter in chosen]


def _map(held_out: HeldOut, columns: Sequence[Column], emitter: int) -> MeasuredMaps:
    pairs = held_out.pairs
    measured = np.flatnonzero(pairs.pair_emitter == emitter)
    power = np.array([_power(pairs.response(int(pair))[held_out.yaw_indices]) for pair in measured])
    levels = {"measured": power}
    for column in columns:
        estimated = np.full(len(measured), np.nan)
        for place, pair in enumerate(measured):
            for index in np.flatnonzero(held_out.held_out == pair):
                answer = column.source(int(index), held_out.yaw_indices)
                estimated[place] = np.nan if answer is None else _power(answer)
        levels[column.name] = estimated
    if not power.max() > 0:
        raise EvaluationError(f"{held_out.name}: emitter {emitter} is silent everywhere")
    return MeasuredMaps(
        np.asarray(pairs.emitter_positions[emitter]),
        np.asarray(pairs.listener_positions[pairs.pair_listener[measured]]),
        {name: np.maximum(power_to_db(values / power.max()), _LEAST_DB) for name, values in levels.items()},
    )


def _power(responses: Responses) -> float:
    return float(np.square(responses, dtype=np.float64).sum(axis=-1).mean())


def draw_measured(maps: Sequence[MeasuredMaps], path: Path) -> None:
    """Write a PNG with a row per emitter and a column per method, in the plane of the two coordinates that vary most;
    known listeners are small, held-out ones large."""
    methods = list(maps[0].levels_db)
    figure = Figure(figsize=(3.1 * len(methods) + 1.2, 2.7 * len(maps) + 0.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(maps), len(methods), squeeze=False, sharex=True, sharey=True)
    across, up = np.sort(np.argsort(np.ptp(np.concatenate([each.listeners for each in maps]), axis=0))[1:])
    levels = np.concatenate([each.levels_db["measured"] for each in maps])
    limits = {"vmin": float(np.percentile(levels, 1)), "vmax": float(np.percentile(levels, 99)), "cmap": "viridis"}
    drawn = None
    for axes_of_row, each in zip(panels, maps, strict=True):
        known = np.all([np.isnan(each.levels_db[method]) for method in methods[1:]], axis=0)
        for axes, method in zip(axes_of_row, methods, strict=True):
            shown = np.where(known, each.levels_db["measured"], each.levels_db[method])
            for where, size in ((known, 16), (~known, 90)):
                places = each.listeners[where]
                drawn = axes.scatter(places[:, across], places[:, up], c=shown[where], s=size, **limits)
            error = "" if method == "measured" else f", off by {each.error_db(method):.1f} dB"
            axes.set_title(f"{method}{error}", fontsize=10)
            axes.set(xlabel=_AXES[across], ylabel=_AXES[up])
            axes.label_outer()
    assert drawn is not None
    figure.colorbar(drawn, ax=panels, shrink=0.8, pad=0.01, extend="both").set_label("level (dB re loudest)")
    figure.savefig(path, dpi=110)
