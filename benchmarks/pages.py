"""Fills the tables and plots of `docs/results/` from JSON: `python -m benchmarks.pages`, or `make results`.

A page has a mark above each table and `<!-- end -->` below it. What stands between them is written anew:

    <!-- provenance: NAME -->    host, date, commit and command of benchmarks/results/NAME.json
    <!-- table: NAME TABLE -->   one of its tables
    <!-- history: BENCH -->      the newest runs in benchmarks/history/BENCH.json

A plot is drawn anew where its file says that it was drawn from other data. To draw it anew all the same, delete it.
"""

import hashlib
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from PIL import Image

from benchmarks.record import Result, markdown_table, read_results
from server.bench.history import Run, read_history
from server.bench.report import show

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT: Final = Path(__file__).parents[1]
PAGES: Final = ROOT / "docs" / "results"
HISTORY: Final = ROOT / "benchmarks" / "history"
REGION: Final = re.compile(
    r"^<!-- (provenance|table|history): ([a-z0-9-]+)(?: ([a-z-]+))? -->\n.*?^<!-- end -->$", re.MULTILINE | re.DOTALL
)
_NEWEST: Final = 4
_SOURCE: Final = "Drawn from"
"""The metadata entry of a PNG with the digest of its data."""


def filled(page: str, results: Mapping[str, Result], histories: Mapping[str, list[Run]]) -> str:
    """Return the page with its tables filled in. Raises KeyError for a mark that names no result, table or history."""

    def region(mark: re.Match[str]) -> str:
        kind, name, table = mark.groups()
        if kind == "history":
            text = history_table(histories[name])
        else:
            text = results[name].provenance() if kind == "provenance" else results[name].tables[table].markdown()
        return mark[0].splitlines()[0] + f"\n{text}<!-- end -->"

    return REGION.sub(region, page)


def history_table(runs: list[Run]) -> str:
    """Return a table with a column for each of the newest runs, the newest last."""
    runs = runs[-_NEWEST:]
    rows = {
        "": [f"{run.date:%Y-%m-%d %H:%M}" for run in runs],
        "processor": [run.host.name for run in runs],
        "cores; load": [f"{run.host.cores or 'unknown'}; {show(run.host.load)}" for run in runs],
        "commit": [run.commit[:12] + ("+changes" if run.commit.endswith("+changes") else "") for run in runs],
        "command": [f"`{run.command}`" for run in runs],
        **{
            name: [show(run.figures.get(name)) for run in runs]
            for name in dict.fromkeys(name for run in runs for name in run.figures)
        },
        "not reached": ["<br>".join(run.failures) for run in runs],
    }
    first, *others = ([name, *cells] for name, cells in rows.items())
    return markdown_table([first, ["---"] * len(first), *others])


def read_histories() -> dict[str, list[Run]]:
    return {path.stem: read_history(path) for path in sorted(HISTORY.glob("*.json"))}


def plots(
    results: Mapping[str, Result], histories: Mapping[str, list[Run]]
) -> Iterator[tuple[Path, str, Callable[[], "Figure"]]]:
    """Yield for every plot its file, the digest of its data, and a function that draws it."""
    for result in results.values():
        for file, plot in result.plots.items():
            yield PAGES / file, _digest(result.model_dump_json()), partial(_draw, plot, result)
    for name, runs in histories.items():
        digest = _digest(json.dumps([run.model_dump_json() for run in runs]))
        yield PAGES / "history" / f"{name}.png", digest, partial(_draw_history, runs)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _draw(plot: str, result: Result) -> "Figure":
    from benchmarks.plots import PLOTS

    return PLOTS[plot](result)


def _draw_history(runs: list[Run]) -> "Figure":
    from benchmarks.plots import history

    return history(runs)


def drawn_from(path: Path) -> str | None:
    """Return the digest of the data from which a plot was drawn; None without a plot or a digest in it."""
    if not path.exists():
        return None
    with Image.open(path) as image:
        return image.info.get(_SOURCE)


def main() -> None:
    results, histories = read_results(), read_histories()
    for page in sorted(PAGES.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (anew := filled(text, results, histories)) != text:
            page.write_text(anew, encoding="utf-8")
            sys.stdout.write(f"{page.relative_to(ROOT)}\n")
    for path, digest, draw in plots(results, histories):
        if drawn_from(path) != digest:
            path.parent.mkdir(parents=True, exist_ok=True)
            draw().savefig(path, dpi=100, metadata={_SOURCE: digest, "Software": None})
            sys.stdout.write(f"{path.relative_to(ROOT)}\n")


if __name__ == "__main__":
    main()
