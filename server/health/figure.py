"""Figure of a health check: measurements, bounds, and the places of the worst poses."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from server.core.errors import NafirError
from server.health.check import Health
from server.health.energies import WINDOW_S
from server.health.findings import BATCH, DECAY, DOUBLE, ENERGY, LEVEL_PER_CM, LEVEL_PER_DEGREE, Finding
from server.health.poses import EMITTER, LISTENER
from server.health.report import verdict
from server.scene.bundle import Bundle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = ("#0b6e99", "#d1495b", "#66a182", "#8d6a9f", "#edae49", "#3d5a80", "#a68a64", "#bc4b51")
_BOUND = "#222222"
_DECAY_DB = (-80.0, 3.0)
_EXACT_DB = (-160.0, 0.0)
_SHOWN = (ENERGY, DECAY, LEVEL_PER_CM, LEVEL_PER_DEGREE)
_MARKERS = {"listener": "o", "emitter": "s", "yaw": "^"}
_MOVING = {"listener": "listener, per cm", "emitter": "emitter, per cm", "yaw": "head, per degree"}


def draw(health: Health, bundle: Bundle, path: Path) -> None:
    """Write a PNG. Raises NafirError if matplotlib, an optional dependency, is not installed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as exc:
        raise NafirError("figure: needs matplotlib; pip install matplotlib, or leave --figure out") from exc
    figure = Figure(figsize=(13.5, 9.0), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{bundle.manifest.name}: {verdict(health)}", fontsize=14)
    panels = figure.subplot_mosaic([["energy", "decay", "change"], ["plan", "plan", "exact"]])
    _draw_energy(panels["energy"], health)
    _draw_decays(panels["decay"], health)
    _draw_changes(panels["change"], health)
    _draw_plan(panels["plan"], health, bundle)
    _draw_exactness(panels["exact"], health)
    for axes in panels.values():
        axes.grid(alpha=0.25)
    figure.savefig(path, dpi=110)


def _draw_energy(axes: "Axes", health: Health) -> None:
    axes.set(title="Energy of responses", xlabel="distance (m)", ylabel="re limit by the walls' absorption (dB)")
    for colour, (name, evidence) in zip(_COLOURS, health.evidence.items(), strict=False):
        if evidence.excess_db is None:
            continue
        distance = np.linalg.norm(evidence.poses[:, LISTENER] - evidence.poses[:, EMITTER], axis=-1)
        axes.plot(distance, evidence.excess_db, ".", markersize=3.5, color=colour, label=name)
    if all(evidence.excess_db is None for evidence in health.evidence.values()):
        axes.text(0.5, 0.5, "no walls are known, or no field is there", ha="center", transform=axes.transAxes)
        return
    axes.axhline(0.0, color=_BOUND, linestyle="--", label="bound")
    axes.legend(frameon=False, fontsize=8, loc="lower left")


def _draw_decays(axes: "Axes", health: Health) -> None:
    axes.set(
        title="Decay: median, and all but 2 %", xlabel="time from the first sound (s)", ylabel="re loudest 20 ms (dB)"
    )
    for colour, (name, evidence) in zip(_COLOURS, health.evidence.items(), strict=False):
        levels_db = evidence.decays_db - evidence.decays_db.max(axis=-1, keepdims=True)
        low, middle, high = np.nanpercentile(levels_db.reshape(-1, levels_db.shape[-1]), (1, 50, 99), axis=0)
        times_s = WINDOW_S * np.arange(levels_db.shape[-1])
        axes.fill_between(times_s, low, high, color=colour, alpha=0.18, linewidth=0)
        axes.plot(times_s, middle, color=colour, label=name)
    axes.set_ylim(*_DECAY_DB)


def _draw_changes(axes: "Axes", health: Health) -> None:
    axes.set(title="Steepest changes of level found", xlabel="rank", ylabel="dB per step", yscale="log")
    for colour, evidence in zip(_COLOURS, health.evidence.values(), strict=False):
        for what, changes_db in evidence.changes_db.items():
            ranked = np.sort(changes_db)[::-1]
            axes.plot(1 + np.arange(len(ranked)), ranked, _MARKERS[what], markersize=4, color=colour)
    for what, marker in _MARKERS.items():
        axes.plot([], [], marker, color="#777777", label=_MOVING[what])
    axes.axhline(LEVEL_PER_CM.bound, color=_BOUND, linestyle="--")
    axes.legend(frameon=False, fontsize=8, loc="center right")


def _draw_plan(axes: "Axes", health: Health, bundle: Bundle) -> None:
    axes.set(title="Where fields come nearest to a law: listener (o) and emitter (x)", xlabel="x (m)", ylabel="y (m)")
    corners = np.array([*bundle.floor_plan.corners, bundle.floor_plan.corners[0]])
    axes.plot(*corners.T, color=_BOUND, linewidth=1.5)
    worst: dict[str, Finding] = {}
    for finding in health.findings:
        if finding.law in _SHOWN and finding.pose is not None and finding.value:
            label = f"{finding.law.label}, {finding.moving}" if finding.moving else finding.law.label
            if label not in worst or finding.value > worst[label].value:
                worst[label] = finding
    for colour, (label, finding) in zip(_COLOURS, worst.items(), strict=False):
        if finding.pose is not None:
            (x, y), (ex, ey) = finding.pose[LISTENER][:2], finding.pose[EMITTER][:2]
            axes.plot([x, ex], [y, ey], color=colour, alpha=0.5)
            axes.plot(x, y, "o", color=colour, label=f"{label}: {finding.value:.2g} {finding.law.unit}")
            axes.plot(ex, ey, "x", color=colour, markersize=8, markeredgewidth=2)
    axes.set_aspect("equal")
    axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncol=2)


def _draw_exactness(axes: "Axes", health: Health) -> None:
    axes.set(title="Responses of each level", ylabel="re the response (dB)", ylim=_EXACT_DB)
    names = list(dict.fromkeys(finding.of for finding in health.findings if finding.law.name == DOUBLE.name))
    for law, marker, colour in ((DOUBLE, "o", _COLOURS[0]), (BATCH, "s", _COLOURS[2])):
        found = [finding for finding in health.findings if finding.law.name == law.name]
        at = [names.index(finding.of) for finding in found]
        shown = np.maximum([finding.value for finding in found], _EXACT_DB[0])
        axes.plot(at, shown, marker, color=colour, label=f"{law.label} (bar: bound)")
        axes.plot(at, [finding.law.bound for finding in found], "_", color=colour, markersize=24)
    axes.set_xticks(range(len(names)), names, rotation=20, ha="right", fontsize=8)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.legend(frameon=False, fontsize=8, loc="center right")
