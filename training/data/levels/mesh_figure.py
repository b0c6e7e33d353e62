"""The picture of a level's mesh: a plan of each storey, and a view from above and aside, with what is at fault in
colours."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import fill
from typing import Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from training.data.levels.examination import Drawn, Examination

_Floats = npt.NDArray[np.float64]

_TEXT, _SURFACE = "#2b3a42", "#7d8a90"
_FLOOR = (0.945, 0.955, 0.960)
_FACES = {
    "turned": ("#2a6fbb", "faced away from the air: turned"),
    "doubled": ("#edae49", "there twice, or lying on each other"),
    "crossing": ("#8d4fb3", "go through others"),
    "slivers": ("#66a182", "slivers"),
    "doors": ("#0b9e8e", "doors, shut"),
}
"""Colour and label of each kind of triangle; later ones are drawn on top."""
_EDGES: dict[str, tuple[str, Literal[":", "-"], str]] = {
    "seams": ("#7d8a90", ":", "seams without common vertices"),
    "branching": ("#c46a1c", "-", "edges of more than two faces"),
    "open_edges": ("#d1193b", "-", "holes"),
}
_RAYS, _PLACES = "#f07a8d", "#2b3a42"
_MOST_STOREYS = 6
_MOST_FACES_IN_3D = 15_000
_STOREY_M, _FLOOR_SHARE = 2.0, 0.25
_CUT_M = 1.3
"""Plans are cut at this height above the floor of a storey, as architects' are."""


def draw_mesh(
    examination: Examination, path: Path, title: str, places: Sequence[tuple[str, tuple[float, ...]]]
) -> None:
    """Write the figure as a PNG. `places` are named points."""
    figure = figure_of(examination, title, places)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=100)


def figure_of(examination: Examination, title: str, places: Sequence[tuple[str, tuple[float, ...]]]) -> Figure:
    """A panel for each storey, from the lowest, and one in three dimensions."""
    storeys = storeys_of(examination)
    figure = Figure(figsize=(7.0 * min(3, len(storeys) + 1), 7.2 * -(-(len(storeys) + 1) // 3)), layout="constrained")
    figure.set_facecolor("white")
    across = min(3, len(storeys) + 1)
    down = -(-(len(storeys) + 1) // across)
    for number, (floor, ceiling) in enumerate(storeys):
        axes = figure.add_subplot(down, across, number + 1)
        _draw_storey(axes, examination, floor, ceiling, places)
        axes.set_title(
            f"storey {number + 1}: floor at {floor:.2f} m, cut at {floor + _CUT_M:.2f} m", fontsize=11, color=_TEXT
        )
    _draw_view(figure.add_subplot(down, across, len(storeys) + 1, projection="3d"), examination)
    figure.suptitle(fill(title, 110), fontsize=13, color=_TEXT)
    figure.legend(handles=list(_legend(examination)), loc="outside lower center", ncols=4, frameon=False, fontsize=10)
    return figure


def storeys_of(examination: Examination) -> list[tuple[float, float]]:
    """(floor, ceiling) of each storey, from the lowest: heights at which much area faces up, a storey apart."""
    mesh = examination.mesh
    low, high = float(mesh.bounds_m[0, 2]), float(mesh.bounds_m[1, 2])
    level = mesh.normals[:, 2] > 0.9
    heights, areas = mesh.corners_m[level].mean(axis=1)[:, 2], mesh.areas_m2[level]
    floors: list[float] = []
    if len(heights):
        edges = np.arange(low - 0.1, high + 0.3, 0.2)
        counts, _ = np.histogram(heights, edges, weights=areas)
        for index in np.flatnonzero(counts >= _FLOOR_SHARE * counts.max()):
            floor = float(np.median(heights[(heights >= edges[index]) & (heights < edges[index + 1])]))
            if not floors or floor - floors[-1] >= _STOREY_M:
                floors.append(floor)
    floors = [floor for floor in floors if high - floor > _CUT_M][:_MOST_STOREYS] or [low]
    return list(zip(floors, [*floors[1:], high], strict=True))


def section(corners: _Floats, height_m: float) -> _Floats:
    """(n, 2, 2) lines in plan along which triangles (T, 3, 3) cross a level plane."""
    above = corners[:, :, 2] > height_m
    crossed = corners[above.any(axis=1) & ~above.all(axis=1)]
    lines = np.full((len(crossed), 2, 2), np.nan)
    filled = np.zeros(len(crossed), np.int64)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        one, two = crossed[:, first], crossed[:, second]
        hits = (one[:, 2] > height_m) != (two[:, 2] > height_m)
        rise = np.where(hits, two[:, 2] - one[:, 2], 1.0)
        at = one + (two - one) * ((height_m - one[:, 2]) / rise)[:, None]
        rows = np.flatnonzero(hits)
        lines[rows, filled[rows]] = at[rows, :2]
        filled[rows] += 1
    return lines


def _draw_storey(
    axes: Axes,
    examination: Examination,
    floor: float,
    ceiling: float,
    places: Sequence[tuple[str, tuple[float, ...]]],
) -> None:
    drawn, cut = examination.drawn, floor + min(_CUT_M, 0.6 * (ceiling - floor))
    mesh = examination.mesh
    heights = mesh.corners_m[:, :, 2].mean(axis=1)
    tops = np.flatnonzero((mesh.normals[:, 2] > 0.9) & (heights > floor - 0.3) & (heights < cut))
    tops = tops[np.argsort(heights[tops], kind="stable")]
    # The higher, the darker: floors are light, and tables lie on them.
    shades = np.array(_FLOOR) - 0.16 * np.clip((heights[tops, None] - floor) / _CUT_M, 0, 1)
    axes.add_collection(
        PolyCollection(list(mesh.corners_m[tops][:, :, :2]), facecolors=shades, edgecolors=shades, linewidths=0.4)
    )
    axes.add_collection(LineCollection(list(section(drawn.surfaces, cut)), colors=_SURFACE, linewidths=2.0))
    for name, (colour, _) in _FACES.items():
        faces = _between(getattr(drawn, name), floor - 0.2, ceiling)
        if not len(faces):
            continue
        if name == "doors":
            axes.add_collection(LineCollection(list(section(faces, cut)), colors=colour, linewidths=3.0))
        else:
            axes.add_collection(
                PolyCollection(list(faces[:, :, :2]), facecolor=colour, edgecolor=colour, linewidths=1.2, alpha=0.35)
            )
    for name, (colour, style, _) in _EDGES.items():
        edges = _between(getattr(drawn, name), floor - 0.2, ceiling)
        axes.add_collection(LineCollection(list(edges[:, :, :2]), colors=colour, linestyles=style, linewidths=2.0))
    rays = _between(np.stack([drawn.escape.starts, drawn.escape.ends], axis=1), floor - 0.2, ceiling)
    axes.add_collection(LineCollection(list(rays[:, :, :2]), colors=_RAYS, linewidths=0.5, alpha=0.5))
    for name, (x, y, z) in places:
        if floor - 0.2 <= z < ceiling:
            axes.plot(x, y, "o", color=_PLACES, markersize=4)
            axes.annotate(name, (x, y), xytext=(4, 4), textcoords="offset points", fontsize=8, color=_TEXT)
    low, high = mesh.bounds_m[:, :2]
    margin = 0.04 * float(np.max(high - low))
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal")
    axes.set_xlabel("x, east (m)", color=_TEXT)
    axes.set_ylabel("y, north (m)", color=_TEXT)
    axes.spines[["top", "right"]].set_visible(False)


def _between(corners: _Floats, low: float, high: float) -> _Floats:
    """Those of triangles or lines (n, corner, 3) whose middle is between two heights."""
    middle = corners[:, :, 2].mean(axis=1)
    return np.asarray(corners[(middle >= low) & (middle < high)])


def _draw_view(axes: Axes, examination: Examination) -> None:
    """Surfaces that face up or away from the viewer, as through a roof that was lifted, and all faults."""
    drawn, mesh = examination.drawn, examination.mesh
    viewer = np.array((np.cos(np.radians(-60)), np.sin(np.radians(-60)), 0.9))
    shown = (mesh.normals @ viewer) > 0.05
    chosen = np.flatnonzero(shown)[:: max(1, int(shown.sum()) // _MOST_FACES_IN_3D)]
    light = 0.55 + 0.45 * np.clip(mesh.normals[chosen] @ (np.array((0.3, -0.5, 0.8)) / 0.99), 0, 1)
    colours = np.column_stack([light[:, None] * np.array((0.80, 0.84, 0.86)), np.full(len(chosen), 0.55)])
    axes.add_collection3d(Poly3DCollection(mesh.corners_m[chosen], facecolors=colours, edgecolors="none"))  # type: ignore[attr-defined]
    for name, (colour, _) in _FACES.items():
        faces = getattr(drawn, name)[:_MOST_FACES_IN_3D]
        if len(faces):
            axes.add_collection3d(  # type: ignore[attr-defined]
                Poly3DCollection(faces, facecolors=colour, edgecolors=colour, linewidths=0.8, alpha=0.35)
            )
    for name, (colour, style, _) in _EDGES.items():
        edges = getattr(drawn, name)[:_MOST_FACES_IN_3D]
        if len(edges):
            axes.add_collection3d(Line3DCollection(edges, colors=colour, linestyles=style, linewidths=1.6))  # type: ignore[attr-defined]
    if drawn.escape.left:
        rays = np.stack([drawn.escape.starts, drawn.escape.ends], axis=1)[:100]
        axes.add_collection3d(Line3DCollection(rays, colors=_RAYS, linewidths=0.5, alpha=0.5))  # type: ignore[attr-defined]
    low, high = mesh.bounds_m
    high = np.maximum(high, low + 1e-3)  # a flat level has a third axis too
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    axes.view_init(elev=38, azim=-60)  # type: ignore[attr-defined]
    axes.set_title("surfaces that face the viewer", fontsize=11, color=_TEXT)
    axes.tick_params(labelsize=8)


def _legend(examination: Examination) -> Iterator[Patch | Line2D]:
    """Entries for what there is, with how many."""
    drawn: Drawn = examination.drawn
    yield Line2D([], [], color=_SURFACE, linewidth=2, label="surfaces cut by the plan")
    for name, (colour, label) in _FACES.items():
        if count := len(getattr(drawn, name)):
            yield Patch(facecolor=colour, alpha=0.6, label=label if name == "doors" else f"{label} ({count:,})")
    for name, (colour, style, label) in _EDGES.items():
        if count := len(getattr(drawn, name)):
            yield Line2D([], [], color=colour, linestyle=style, linewidth=2, label=f"{label} ({count:,} edges)")
    if drawn.escape.left:
        share = f"{100 * drawn.escape.share:.2g} %"
        yield Line2D([], [], color=_RAYS, linewidth=1, label=f"rays that left ({share})")
