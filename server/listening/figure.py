"""The results of a listening test as a picture."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from server.core.errors import NafirError
from server.listening.analysis import PAPER, Comparison, Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_OURS, _CHECK, _PAPER = "#0f5a60", "#8a9a96", "#c23d16"


def draw(results: Results, path: Path) -> None:
    """Write a picture in the format of the suffix. Raises NafirError if nobody's answers count, or the file cannot be
    written."""
    if not results.counted:
        raise NafirError("--figure: nobody's answers count yet: leave it out")
    try:
        figure_of(results).savefig(path, dpi=120)
    except (OSError, ValueError) as exc:
        raise NafirError(f"{path}: {exc}") from exc


def figure_of(results: Results) -> "Figure":
    """Shares with Wilson's intervals, or median ratings over errors in JND. Raises ImportError without matplotlib."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = len(results.comparisons) + 1
    height = 0.5 * rows + 1.6 if results.kind == "choice" else 5.0
    figure = Figure(figsize=(9.0, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    if results.kind == "choice":
        _draw_choices(figure.subplots(), results)
    else:
        _draw_ratings(figure, results)
    listeners = "1 listener" if results.counted == 1 else f"{results.counted} listeners"
    figure.suptitle(f"{results.name}: what {listeners} heard")
    return figure


def _draw_choices(axes: "Axes", results: Results) -> None:
    rows: list[tuple[str, Comparison | None]] = []
    for each in results.comparisons:
        rows.append((f"{each.first}\nover {each.second}", each))
        if each.published is not None:
            rows.append((f"{' over '.join(PAPER.over)}\n({PAPER.source})", None))
    rows.reverse()
    for at, (_, comparison) in enumerate(rows):
        share = PAPER.result if comparison is None else comparison.result
        colour = _PAPER if comparison is None else _OURS if comparison.part == "test" else _CHECK
        low, high = share.wilson
        axes.plot([100 * low, 100 * high], [at, at], color=colour, linewidth=2.5, solid_capstyle="butt")
        axes.plot(100 * share.share, at, "o", color=colour, markersize=7)
        text = f"{100 * share.share:.1f} %, {share.count} of {share.trials}"
        side: Literal["left", "center", "right"] = (
            "right" if share.share > 0.9 else "left" if share.share < 0.1 else "center"
        )
        axes.annotate(text, (100 * share.share, at), xytext=(0, 7), textcoords="offset points", ha=side, fontsize=8)
    axes.axvline(50, color="#222222", linewidth=1, linestyle=":")
    axes.set_yticks(range(len(rows)), [title for title, _ in rows], fontsize=8)
    axes.set(xlim=(-4, 104), ylim=(-0.6, len(rows) - 0.3), xlabel="chosen as nearer to the reference (%); Wilson, 95 %")
    axes.grid(axis="x", alpha=0.25)


def _draw_ratings(figure: "Figure", results: Results) -> None:
    by_method, by_error = figure.subplots(1, 2, sharey=True, width_ratios=(1.2, 1))
    for at, each in enumerate(results.rated):
        colour = _OURS if each.kind in {"field", "baseline"} else _CHECK
        _draw_rating(by_method, at, each.result.median, each.result.interval or each.result.quartiles, colour)
        if each.jnd is not None:
            _draw_rating(by_error, each.jnd, each.result.median, each.result.interval or each.result.quartiles, colour)
            by_error.annotate(
                each.method, (each.jnd, each.result.median), xytext=(6, 4), textcoords="offset points", fontsize=7
            )
    by_method.set_xticks(
        range(len(results.rated)), [each.method for each in results.rated], rotation=40, ha="right", fontsize=8
    )
    by_method.set(ylim=(-2, 102), ylabel="rating: median, and 95 % over listeners")
    by_error.set(xlabel="error in just-noticeable differences")
    by_error.margins(x=0.3)
    if (agreement := results.agreement) is not None:
        by_error.set_title(f"Spearman's rho {agreement.rho:.2f}, {agreement.count} levels", fontsize=9)
    for axes in (by_method, by_error):
        axes.grid(axis="y", alpha=0.25)


def _draw_rating(axes: "Axes", x: float, median: float, interval: tuple[float, float], colour: str) -> None:
    axes.plot([x, x], interval, color=colour, linewidth=2.5, solid_capstyle="butt")
    axes.plot(x, median, "o", color=colour, markersize=7)
