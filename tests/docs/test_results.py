"""Every table and plot of the results comes from JSON that says where, when, of what and by which command."""

import re
from decimal import Decimal
from pathlib import Path

import pytest
from pydantic import ValidationError

from benchmarks.pages import PAGES, REGION, drawn_from, filled, plots, read_histories
from benchmarks.plots import PLOTS, history
from benchmarks.record import FOLDER, Result, Value, read_results
from server.bench.history import Run, RunHost

RESULTS, HISTORIES = read_results(), read_histories()
TEXTS = {path.relative_to(PAGES): path.read_text() for path in sorted(PAGES.rglob("*.md"))}
pages = pytest.mark.parametrize("page", TEXTS, ids=str)
HOST = {"processor": "unknown", "instruction_set": "unknown", "cores": "unknown"}


@pages
def test_every_table_is_as_its_json_has_it(page: Path) -> None:
    """`make results` writes them."""
    assert filled(TEXTS[page], RESULTS, HISTORIES) == TEXTS[page]


@pages
def test_no_table_is_written_by_hand(page: Path) -> None:
    by_hand = re.findall(r"^\s*\|.*", REGION.sub("", TEXTS[page]), re.MULTILINE)
    assert by_hand == []
    assert "<table" not in TEXTS[page]


@pages
def test_every_plot_is_drawn_from_the_json_that_names_it(page: Path) -> None:
    digests = {path: digest for path, digest, _ in plots(RESULTS, HISTORIES)}
    for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", TEXTS[page]):
        path = (PAGES / page.parent / name).resolve()
        assert path in digests, f"{name} is in no JSON"
        assert drawn_from(path) == digests[path], f"{name}: run `make results`"


def test_every_json_is_shown_on_some_page() -> None:
    shown = {mark[1:] for text in TEXTS.values() for mark in REGION.findall(text) for mark in [mark]}
    tables = {(name, table) for name, result in RESULTS.items() for table in result.tables}
    histories = {(name, "") for name in HISTORIES}
    assert len(tables) > 20
    assert tables | histories <= shown
    named = {name for text in TEXTS.values() for name in re.findall(r"([\w-]+\.png)\)", text)}
    assert {path.name for path, _, _ in plots(RESULTS, HISTORIES)} == named
    assert {path.name for path in PAGES.rglob("*") if path.is_file() and path.suffix != ".md"} == named


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.iterdir()))
def test_every_result_says_where_it_is_from(name: str) -> None:
    """No field is missing or unknown to the form, and every row has as many cells as there are columns."""
    result = RESULTS[name]
    assert result.command
    assert [table.markdown() for table in result.tables.values()] or result.plots
    assert set(result.plots.values()) <= set(PLOTS)


@pytest.mark.parametrize("missing", ["host", "date", "commit", "command"])
def test_a_result_without_provenance_is_refused(missing: str) -> None:
    whole = {"host": HOST, "date": "2026-11-25", "commit": "unknown", "command": "nafir bench field"}
    Result.model_validate(whole)
    with pytest.raises(ValidationError, match=missing):
        Result.model_validate({name: value for name, value in whole.items() if name != missing})
    with pytest.raises(ValidationError, match=missing):
        Result.model_validate(whole | {missing: "some day"} if missing != "command" else {})


def test_numbers_keep_the_digits_that_were_written(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(
        '{"host": {"processor": "P", "instruction_set": "AVX2", "cores": 1}, "date": "2026-11-21/2026-11-22",'
        ' "commit": "0123abc", "command": "c", "tables": {"t": {"columns": [{"title": "a"}, {"title": "b", '
        '"is_number": true}], "rows": [[1.40, null], [{"value": 2.0, "unit": "%", "is_best": true, "note": "3"}, 7]]}}}'
    )
    result = Result.read(tmp_path / "a.json")
    table = result.tables["t"]
    assert table.markdown() == "| a | b |\n| --- | ---: |\n| 1.40 | |\n| **2.0 %** (3) | 7 |\n"
    assert (table.column("a"), table.column("b")) == ([1.4, 2.0], [None, 7.0])
    assert result.provenance().splitlines()[2:4] == [
        "| Host | P; AVX2; one core |",
        "| Recorded | 2026-11-21 to 2026-11-22 |",
    ]
    assert str(Value(value=Decimal("0.10"))) == "0.10"


@pytest.mark.parametrize("plot", [draw for _, _, draw in plots(RESULTS, {})])
def test_every_plot_can_be_drawn_anew(plot) -> None:
    figure = plot()
    assert any(axes.has_data() for axes in figure.axes)


def test_a_history_is_plotted_in_units_of_the_median() -> None:
    host = RunHost(processor="P", instruction_set="AVX2", cores=2, load=None)
    values = [1.0, 2.0, 4.0, None]
    runs = [Run.now("c", {"ms": value}, ()).model_copy(update={"host": host}) for value in values]
    (axes,) = history(runs).axes
    assert list(axes.lines[0].get_ydata()) == [0.5, 1.0, 2.0]


def test_of_several_runs_a_figure_that_one_has_is_not_plotted() -> None:
    figures = ({"old": 1.0, "ms": 1.0}, {"new": 1.0, "ms": 2.0})
    (axes,) = history([Run.now("c", each, ()) for each in figures]).axes
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["ms"]
