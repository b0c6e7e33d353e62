"""Plots of results, and of the history of benchmarks. Each function takes the data and returns a figure."""

import base64
import io
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import Final

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from PIL import Image

from benchmarks.record import Result, Table
from server.acoustics.metrics import PARAMETER_METRICS
from server.bench.history import Run
from server.planning.plan_figure import figure_of
from server.planning.plan_query import PlanDocument
from training.frontier.labels import Label, place_labels

_FIRST, _OTHER, _FLOOR, _TEXT = "#0b6e99", "#aeb9c1", "#8d6a9f", "#2b3a42"
_METHODS: Final = {
    "naf-whole": ("v", "#edae49", "the paper's network, whole responses (naf-whole)"),
    "naf": ("^", "#d1495b", "the same network, reflected sound (naf)"),
    "nearest": ("s", "#66a182", "nearest pair"),
    "one simulation": ("x", "#8d6a9f", "one simulation"),
    "default level": ("o", _FIRST, "default level"),
}
"""Marker, colour and label of each method; the last is drawn on top."""
_ERRORS: Final = (
    "spectral loss (ln)", "T60 (%)", "EDT (ms)", "C50 (dB)", "DRR (dB)", "IACC", "level (dB)", "ITD (us)",
)  # fmt: skip


def plan_of_effects(result: Result) -> Figure:
    """Draw the change without each effect of a plan, beside its cost."""
    return figure_of(PlanDocument.model_validate(result.values["plan"]))


def error_over_time(result: Result) -> Figure:
    """Draw the mean error of every level over its mean time, offered levels as filled markers, the floor as a line."""
    table = result.tables["levels"]
    names = [str(row[0]) for row in table.rows]
    times, errors = table.column("mean ms"), table.column("mean error, JND")
    middle, slowest = table.column("p50 ms"), table.column("p99 ms")
    figure, axes = _one_panel(9.0, 5.2)
    labels: list[Label] = []
    markers: list[tuple[float, float]] = []
    floors: list[float] = []
    for name, time_ms, error, p50, p99 in zip(names, times, errors, middle, slowest, strict=True):
        if error is None:
            continue
        if time_ms is None:
            axes.axhline(error, color=_FLOOR, linestyle="--", linewidth=1.2, label="the same simulated twice (floor)")
            floors.append(error)
            continue
        is_offered = "(o" in name
        if p50 is not None and p99 is not None:
            axes.hlines(error, p50, p99, color="#bfdbe6", linewidth=3, zorder=1)
        face, order = (_FIRST, 4) if is_offered else ("white", 3)
        axes.scatter(time_ms, error, s=40, facecolors=face, edgecolors=_FIRST, zorder=order)
        markers.append((time_ms, error))
        if is_offered:
            said = name.split("`")[1] + (" (default)" if "default" in name else "")
            labels.append(Label(time_ms, error, said))
    axes.set_xscale("log")
    axes.set_ylim(0, 1.08 * max(error for error in errors if error is not None))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set(
        xlabel="milliseconds per pose of a walk; points at the mean, bars from the median to the slowest of a hundred",
        ylabel="mean error, just-noticeable differences",
    )
    axes.legend(frameon=False, fontsize=9, loc="lower left")
    place_labels(axes, labels, markers, lines_y=floors, colour=_TEXT, line_colour=_OTHER)
    return figure


def times_floor(result: Result) -> Figure:
    """Draw a panel per metric: scenes from left to right, the mean error divided by the floor's mean error upwards."""
    by_scene = _rows_by_scene(result.tables["errors"])
    figure = Figure(figsize=(11.5, 6.8), layout="constrained", facecolor="white")
    panels = figure.subplots(2, len(_ERRORS) // 2, sharex=True, sharey=True).ravel()
    for axes, metric in zip(panels, _ERRORS, strict=True):
        axes.axhline(1.0, color=_FLOOR, linestyle="--", linewidth=1.2, label="two simulations of a pair (floor)")
        for method, (marker, colour, label) in _METHODS.items():
            ratios = [_ratio(rows, method, metric) for rows in by_scene.values()]
            axes.plot(ratios, marker=marker, markersize=6, color=colour, linewidth=1.0, label=label)
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_title(metric.partition(" (")[0], fontsize=11, color=_TEXT)
        axes.set_xticks(range(len(by_scene)), list(by_scene), rotation=30, ha="right", fontsize=9)
        _bare(axes)
    for axes in panels[:: len(_ERRORS) // 2]:
        axes.set_ylabel("mean error, times the floor", color=_TEXT)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside upper left", ncols=3, frameon=False, fontsize=10)
    return figure


def _rows_by_scene(table: Table) -> dict[str, dict[str, dict[str, float | None]]]:
    """Return the numbers by scene, method and column, without the rows of means. A scene's first row is its default
    level."""
    found: dict[str, dict[str, dict[str, float | None]]] = {}
    columns = {column.title: table.column(column.title) for column in table.columns}
    scene = ""
    for at, row in enumerate(table.rows):
        method = str(row[1])
        if row[0]:
            scene, method = str(row[0]).strip("[").partition("]")[0], "default level"
        found.setdefault(scene, {})[method] = {title: numbers[at] for title, numbers in columns.items()}
    del found["mean"]
    return found


def _ratio(rows: Mapping[str, Mapping[str, float | None]], method: str, metric: str) -> float:
    error, floor = rows[method][metric], rows["floor"][metric]
    return np.nan if error is None or not floor else error / floor


def fractions(result: Result) -> Figure:
    """Draw errors over the fraction of training pairs."""
    from training.trials.fractions import Fractions
    from training.trials.fractions_figure import figure_of as figure_of_fractions

    # Numbers of records are decimal.
    plain = json.loads(json.dumps(result.values["fractions"], default=float))
    return figure_of_fractions(Fractions.from_json(plain))


def held_back_losses(result: Result) -> Figure:
    """Draw the held-back loss of networks over their steps, and that of the training set's mean, a panel a scene."""
    networks = json.loads(json.dumps(result.values["networks"], default=float))
    figure = Figure(figsize=(6.6 * len(networks), 3.6), layout="constrained", facecolor="white")
    for axes, (scene, of_scene) in zip(np.atleast_1d(figure.subplots(1, len(networks))), networks.items(), strict=True):
        for name, record in of_scene.items():
            steps, losses = np.array(record["curve"]).T
            axes.plot(steps, losses, marker=".", label=name)
        mean_loss = np.mean([record["mean_loss"] for record in of_scene.values()])
        axes.axhline(mean_loss, color="#8a8a8a", linestyle="--", label="the training set's mean")
        least = min(loss for record in of_scene.values() for _, loss in record["curve"])
        # The first steps are far above the mean, where nothing is learned of places.
        axes.set_ylim(least - 0.2 * (mean_loss - least), mean_loss + (mean_loss - least))
        later = [step for record in of_scene.values() for step, loss in record["curve"] if loss < 2 * mean_loss - least]
        axes.set_xlim(left=0.8 * min(later, default=1))
        axes.set(xscale="log", xlabel="steps", ylabel="loss on held-back pairs", title=scene)
        axes.legend(frameon=False, fontsize=9)
        _bare(axes)
    return figure


def errors_of_meshes(result: Result) -> Figure:
    """Draw the error of each scene as a mesh over the floor, and the range of chance, a panel per metric."""
    ratios = result.values["ratios"]
    assert isinstance(ratios, dict)
    names = list(next(iter(ratios.values())))
    figure = Figure(figsize=(10.0, 5.6), layout="constrained", facecolor="white")
    panels = figure.subplots(2, -(-len(names) // 2), sharex=True, sharey=True).ravel()
    for axes, name in zip(panels, names, strict=True):
        values, low, high = np.array([[float(number) for number in of[name]] for of in ratios.values()]).T
        at = np.arange(len(values))
        axes.vlines(at, low, high, color=_OTHER, linewidth=7, label="nine in ten by chance, if both were the same")
        axes.axhline(1.0, color=_FLOOR, linestyle="--", linewidth=1.2, label="a take of the plan (floor)")
        axes.plot(at, values, "o", color=_FIRST, label="a take of the mesh, from one of the plan")
        (metric,) = (each for each in PARAMETER_METRICS if each.name == name)
        axes.set_title(metric.label, fontsize=11, color=_TEXT)
        axes.set_xticks(at, list(ratios), rotation=30, ha="right", fontsize=9)
        axes.set_ylim(0, 2)
        _bare(axes)
    for axes in panels[:: len(panels) // 2]:
        axes.set_ylabel("mean error, times the floor", color=_TEXT)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=3, frameon=False, fontsize=9)
    return figure


def losses_at_a_screen(result: Result) -> Figure:
    """Draw the loss at the edge of a screen over the Fresnel number."""
    table = result.tables["screen"]
    numbers = table.column("Fresnel number")
    figure, axes = _one_panel(7.5, 4.6)
    styles = {
        "mesh, dB": ("o-", _FIRST, "mesh"),
        "Maekawa, dB": ("s", "#d1495b", "measured by Maekawa"),
        "rigid half-plane, dB": ("--", "#66a182", "half-plane that reflects everything"),
        "absorbing half-plane, dB": (":", "#edae49", "half-plane that reflects nothing"),
    }
    for title, (style, colour, label) in styles.items():
        losses = table.column(title)
        known = [(number, loss) for number, loss in zip(numbers, losses, strict=True) if loss is not None]
        axes.plot(*zip(*known, strict=True), style, color=colour, label=label, markersize=6)
    axes.set_xscale("symlog", linthresh=0.1)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set(xlabel="Fresnel number; below zero, the two are in sight of each other", ylabel="loss, dB")
    axes.legend(frameon=False, fontsize=9)
    return figure


def pictures_side_by_side(result: Result) -> Figure:
    """Show the true pictures and those of each method, a column each."""
    titles, stored = result.values["columns"], result.values["png"]
    assert isinstance(titles, list)
    assert isinstance(stored, str)
    with Image.open(io.BytesIO(base64.b64decode(stored))) as image:
        pixels = np.asarray(image)
    height, width = pixels.shape[:2]
    figure = Figure(figsize=(8.0, 8.0 * height / width + 0.3), layout="constrained", facecolor="white")
    axes = figure.subplots()
    axes.imshow(pixels, interpolation="nearest")
    axes.xaxis.tick_top()
    axes.set_xticks((np.arange(len(titles)) + 0.5) * width / len(titles), titles, fontsize=11)
    axes.tick_params(length=0)
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
    return figure


def history(runs: Sequence[Run]) -> Figure:
    """Draw the figures of a benchmark over its runs, divided by the figure's median, with a marker for each host and a
    colour for each thing of which there are figures. A figure of one run among several is left out: it is its own
    median."""
    count_of = Counter(name for run in runs for name, value in run.figures.items() if value is not None)
    names = [name for name, count in count_of.items() if count >= min(2, len(runs))]
    hosts = list(dict.fromkeys(run.host.name for run in runs))
    things = list(dict.fromkeys(name.rpartition(", ")[0] for name in names))
    drawn: Counter[str] = Counter()
    figure, axes = _one_panel(7.5, 2.4 + 0.12 * len(names))
    for name in names:
        thing = name.rpartition(", ")[0]
        known = [(at, run, value) for at, run in enumerate(runs) if (value := run.figures.get(name)) is not None]
        middle = float(np.median([value for _, _, value in known])) if known else 0.0
        if not middle:
            continue
        (line,) = axes.plot(
            [at for at, _, _ in known],
            [value / middle for _, _, value in known],
            color=colormaps["tab20"](things.index(thing) % 20),
            linestyle=("-", "--", ":", "-.")[drawn[thing] % 4],
            label=name,
        )
        drawn[thing] += 1
        for host, points in groupby(known, key=lambda point: point[1].host.name):
            marker = "osv^Dx+*"[hosts.index(host) % 8]
            for at, run, value in points:
                face = line.get_color() if not run.failures else "white"
                axes.plot(at, value / middle, marker=marker, color=line.get_color(), markerfacecolor=face)
    axes.set_xticks(range(len(runs)), [f"{run.date:%Y-%m-%d}\n{run.commit[:7]}" for run in runs], fontsize=8)
    axes.set_xlim(-0.5, len(runs) - 0.5)
    axes.set_yscale("log", base=2)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylabel("times the median")
    axes.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _one_panel(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    axes = figure.subplots()
    _bare(axes)
    return figure, axes


def _bare(axes: Axes) -> None:
    axes.grid(axis="y", alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


PLOTS: Final[Mapping[str, Callable[[Result], Figure]]] = {
    each.__name__: each
    for each in (
        plan_of_effects,
        error_over_time,
        times_floor,
        fractions,
        held_back_losses,
        errors_of_meshes,
        losses_at_a_screen,
        pictures_side_by_side,
    )
}
"""Functions that draw a plot, by the name used in results."""
