"""Labels of points in a plot, placed where they cover no marker and no other label."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox

_RINGS_PT = (4.0, 12.0, 22.0, 34.0, 48.0, 64.0, 84.0)
"""Distances of a label from its marker that are tried, nearest first."""
_SIDES = ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (0, 1), (0, -1), (-1, 0))
_MARKER_PT = 6.0
"""Half the width of the square around a marker that stays free."""
_LEADER_PT = 8.0
"""A label further away has a line to its marker."""


@dataclass(frozen=True)
class Label:
    """A text for the point at (x, y), in units of the axes."""

    x: float
    y: float
    text: str


def place_labels(
    axes: Axes,
    labels: Sequence[Label],
    markers: Iterable[tuple[float, float]],
    *,
    lines_y: Iterable[float] = (),
    colour: str,
    line_colour: str,
    size: float = 9.0,
) -> list[Annotation]:
    """Write labels beside their points, within the axes, on no other label and on none of the `markers`; where possible
    also on none of the horizontal lines at `lines_y`. A label for which there is no such place is beside its point all
    the same. Limits and scales of the axes, and its legend, have to be set before."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()
    pixels = figure.dpi / 72
    inside = axes.get_window_extent()
    legend = axes.get_legend()
    taken = [_square(axes, marker, _MARKER_PT * pixels) for marker in markers]
    taken += [] if legend is None else [legend.get_window_extent()]
    levels = [float(axes.transData.transform((1.0, y))[1]) for y in lines_y]
    placed = []
    # Labels at the right have the least room.
    for label in sorted(labels, key=lambda label: label.x, reverse=True):
        annotation = axes.annotate(label.text, (label.x, label.y), (0, 0), textcoords="offset points", fontsize=size)
        extent = annotation.get_window_extent()
        at = axes.transData.transform((label.x, label.y))
        width, height = extent.width / pixels, extent.height / pixels
        boxes = [
            (offset, Bbox(np.array([at, at + extent.size]) + pixels * np.array(offset)))
            for offset in _offsets(width, height)
        ]
        free = [
            (offset, box)
            for offset, box in boxes
            if not any(box.overlaps(other) for other in taken) and _contains(inside, box)
        ]
        clear = [(offset, box) for offset, box in free if not any(box.y0 <= level <= box.y1 for level in levels)]
        offset, box = next(iter(clear or free or boxes))
        annotation.remove()
        placed.append(
            axes.annotate(
                label.text,
                (label.x, label.y),
                offset,
                textcoords="offset points",
                fontsize=size,
                color=colour,
                va="bottom",
                ha="left",
                arrowprops={"arrowstyle": "-", "color": line_colour, "linewidth": 0.8, "shrinkB": _MARKER_PT / 2}
                if _gap(offset, width, height) > _LEADER_PT
                else None,
            )
        )
        taken.append(box)
    return placed


def _offsets(width: float, height: float) -> Iterator[tuple[float, float]]:
    """Offsets in points of the lower left corner of a label from its point, nearest first."""
    for ring, (across, up) in itertools.product(_RINGS_PT, _SIDES):
        x = (_MARKER_PT + ring if across > 0 else -_MARKER_PT - ring - width) if across else -width / 2
        y = (ring if up > 0 else -ring - height) if up else -height / 2
        yield x, y


def _gap(offset: tuple[float, float], width: float, height: float) -> float:
    """The distance in points from a marker to its label, along the axis on which it is greater."""
    x, y = offset
    return max(x, -x - width, y, -y - height) - _MARKER_PT


def _square(axes: Axes, marker: tuple[float, float], half: float) -> Bbox:
    x, y = axes.transData.transform(marker)
    return Bbox.from_extents(x - half, y - half, x + half, y + half)


def _contains(outer: Bbox, inner: Bbox) -> bool:
    return bool(outer.x0 <= inner.x0 and inner.x1 <= outer.x1 and outer.y0 <= inner.y0 and inner.y1 <= outer.y1)
