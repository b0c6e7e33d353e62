"""Draws some minutes of a simulated server: `python tests/streaming/load_figure.py docs/images/load-policy.png`.

Needs matplotlib, which comes with the `training` extra.
"""

import sys
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from simulated_server import SimulatedServer

_TEXT, _BLUE, _RED, _GREY = "#2b3a42", "#0b6e99", "#d1495b", "#e4e8ea"
_END_S = 175.0
_EVENTS = (
    (20.0, 45.0, "six more listeners"),
    (95.0, 96.0, "the host pauses for 1 s"),
    (125.0, 137.0, "another tenant takes 70 %"),
)
_MOST = 3.0
"""Of the time in hand that the picture shows."""


def simulate() -> SimulatedServer:
    """Two listeners stay; what disturbs them is in `_EVENTS`."""
    server = SimulatedServer(speeds=(0.5, 1.0))
    server.open(2)
    (crowd_s, gone_s, _), (pause_s, on_s, _), (taken_s, left_s, _) = _EVENTS
    server.open(6, at_s=crowd_s, until_s=gone_s)
    server.occupy(taken_s, left_s - taken_s, share=0.7)
    server.pause(pause_s, on_s - pause_s)
    return server.run(_END_S)


def draw(server: SimulatedServer, path: Path) -> None:
    """Writes a PNG."""
    figure = Figure(figsize=(11.5, 8.2), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(4, 1, sharex=True, height_ratios=(1, 1, 1.3, 1))
    times_s = [look.time_s for look in server.looks]
    busy, at_once, steps, lateness = panels
    busy.plot(times_s, [100 * min(1.0, look.busy) for look in server.looks], color=_BLUE, linewidth=1.2)
    busy.set_ylabel("audio thread\nbusy, %")
    busy.set_ylim(0, 110)
    at_once.step(times_s, [look.blocks_at_once for look in server.looks], where="post", color=_BLUE)
    at_once.set_ylabel("blocks rendered\nat once")
    at_once.set_yscale("log", base=2)
    at_once.set_yticks([1, 2, 4, 8], ["1", "2", "4", "8"])
    at_once.set_ylim(0.8, 10)
    _draw_steps(steps, server)
    lateness.plot(times_s, [100 * min(_MOST, look.lateness) for look in server.looks], color=_BLUE, linewidth=1.2)
    worst = max(server.looks, key=lambda look: look.lateness)
    if worst.lateness > _MOST:
        lateness.text(worst.time_s + 1.5, 100 * _MOST, f"{100 * worst.lateness:.0f} %", color=_BLUE, va="top")
    lateness.axhline(100, color=_RED, linestyle="--", linewidth=1)
    lateness.text(1, 108, "late", color=_RED, va="bottom")
    lateness.set_ylabel("time in hand\nused up, %")
    lateness.set_ylim(0, 105 * _MOST)
    lateness.set_xlabel("seconds")
    for panel in panels:
        panel.set_xlim(0, _END_S)
        panel.spines[["top", "right"]].set_visible(False)
        for begin_s, end_s, _ in _EVENTS:
            panel.axvspan(begin_s, end_s, color=_GREY, zorder=0, linewidth=0)
    for begin_s, end_s, name in _EVENTS:
        busy.text((begin_s + end_s) / 2, 116, name, ha="center", va="bottom", color=_TEXT)
    figure.align_ylabels(panels)
    figure.savefig(path, dpi=110)


def _draw_steps(axes: Axes, server: SimulatedServer) -> None:
    """The two who stay in blue, those who come and go in grey, each a little beside the others."""
    deepest = 1
    for number, client in reversed([*enumerate(server.clients)]):
        end_s = min(client.closed_s, _END_S)
        times_s = [client.opened_s, *(at_s for at_s, _ in client.moves), end_s]
        levels = [0, *(at for _, at in client.moves)]
        deepest = max(deepest, *levels)
        beside = [level + 0.05 * (number - 3.5) for level in levels]
        stays = end_s == _END_S
        axes.step(times_s, [*beside, beside[-1]], where="post", color=_BLUE if stays else "#8a979e", linewidth=1.2)
    axes.set_ylim(deepest + 0.5, -0.5)
    axes.set_yticks(range(deepest + 1), ["best", *(f"{step} down" for step in range(1, deepest + 1))])
    axes.set_ylabel("step of each\nstream")


if __name__ == "__main__":
    draw(simulate(), Path(sys.argv[1]))
