import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from training.evaluation.evaluate import METRICS
from training.evaluation.scenes import ResultError, SceneResult, markdown, step_times, times_markdown
from training.evaluation.scenes_figure import draw_scenes, figure_of


def column(kind, method, error, ms=None):
    summary = {"mean": error, "median": error, "count": 4, "missing": 0, "surpassed_by": []}
    metrics = {metric.name: dict(summary) for metric in METRICS}
    return {"kind": kind, "method": method, "storage_bytes": 1000, "ms": ms, "metrics": metrics}


@pytest.fixture
def result(tmp_path):
    columns = {
        "bundle factorised-r16": column("field", "", 1.0, ms=2.0),
        "bundle factorised-r8": column("field", "", 1.5, ms=1.0),
        "naf": column("field", "naf", 2.0, ms=3000.0),
        "naf-whole": column("field", "naf-whole", 2.5, ms=4000.0),
        "nearest": column("baseline", "nearest", 3.0, ms=0.1),
        "floor": column("floor", "", 0.5),
    }
    columns["naf"]["metrics"]["edt"]["mean"] = 0.75
    columns["bundle factorised-r16"]["metrics"]["edt"]["surpassed_by"] = ["naf"]
    columns["naf"]["metrics"]["c50"]["mean"] = 0.95  # not told from 1.0
    for worse in ("naf", "naf-whole", "nearest"):
        for metric in set(columns[worse]["metrics"]) - {"c50", *({"edt"} if worse == "naf" else ())}:
            columns[worse]["metrics"][metric]["surpassed_by"] = ["bundle factorised-r16"]
    columns["nearest"]["metrics"]["t60"]["mean"] = None

    def write(**changes):
        path = tmp_path / "table.json"
        values = {"data": "flat (simulated)", "pairs": 2, "visible_pairs": 1, "yaws": 2, "columns": columns, **changes}
        path.write_text(json.dumps(values))
        return path

    return write


def test_the_default_level_stands_first_and_bold_is_the_best_and_what_is_not_told_from_it(result):
    lines = markdown([SceneResult.read(result())]).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    heads, _, ours, naf, whole, nearest, floor = cells
    assert [row[:2] for row in (ours, naf, whole, nearest, floor)] == [
        ["flat", "factorised-r16"],
        ["", "naf"],
        ["", "naf-whole"],
        ["", "nearest"],
        ["", "floor"],
    ]
    edt, t60, c50, drr = (heads.index(head) for head in ("EDT (ms)", "T60 (%)", "C50 (dB)", "DRR (dB)"))
    assert (ours[c50], naf[c50], floor[c50]) == ("**1.00**", "**0.950**", "0.500")
    assert (ours[t60], naf[t60], nearest[t60]) == ("**1.00**", "2.00", "")
    assert (ours[edt], naf[edt]) == ("1.00", "**0.750**")
    assert (ours[drr], naf[drr]) == ("**1.00**", "2.00")
    assert (heads[-2:], ours[-2:], naf[-2:]) == (["MB", "ms"], ["0.00100", "2.00"], ["0.00100", "3000"])
    assert lines[-1] == (
        "- flat (2 pairs, 1 in sight, 2 orientations): errs more than naf in EDT, and in C50 not by more than "
        "chance, 1500 times as fast; errs no more than naf-whole in any metric, 2000 times as fast."
    )


def test_the_record_says_what_naf_does_better(result):
    record = SceneResult.read(result()).to_json()
    assert record["worse_than"] == {"naf": ["edt"], "naf-whole": []}
    assert record["methods"]["naf"]["ms"] == 3000.0
    assert "t60" not in record["methods"]["nearest"]["errors"]


def test_what_is_larger_by_chance_alone_is_told(result):
    columns = {"standard": column("field", "", 1.0), "naf": column("field", "naf", 2.0)}
    columns["naf"]["metrics"]["itd"]["mean"] = 0.9
    read = SceneResult.read(result(columns=columns))
    assert (read.worse_than("naf"), read.larger_than("naf")) == ([], ["itd"])
    assert "errs no more than naf in any metric but ITD, and there not by more than chance" in markdown([read])


def test_scenes_of_different_draws_are_not_put_into_one_table(result):
    one, many = SceneResult.read(result()), SceneResult.read(result(draws=9))
    assert (one.to_json()["draws"], many.to_json()["draws"]) == (1, 9)
    assert "medians of 9 draws" in markdown([many])
    with pytest.raises(ResultError, match="1 and 9 draws"):
        markdown([one, many])


def test_one_simulation_stands_beside_the_floor(result):
    columns = {"standard": column("field", "", 1.0), "floor": column("floor", "", 0.5)}
    columns["one simulation"] = column("simulation", "", 0.7)
    rows = markdown([SceneResult.read(result(columns=columns))]).splitlines()[2:]
    assert [row.split("|")[2].strip() for row in rows if row.startswith("|")] == ["standard", "one simulation", "floor"]


def test_means_over_scenes_are_of_methods_that_all_have(result):
    one = SceneResult.read(result())
    columns = {
        "bundle factorised-r32": column("field", "", 3.0, ms=4.0),
        "naf": column("field", "naf", 6.0, ms=5000.0),
        "nearest": column("baseline", "nearest", 5.0, ms=0.3),
        "floor": column("floor", "", 1.5),
    }
    lines = markdown([one, SceneResult.read(result(columns=columns, data="hut (simulated)"))]).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    heads, means = cells[0], cells[-4:]
    assert [row[:2] for row in means] == [["mean", "default level"], ["", "naf"], ["", "nearest"], ["", "floor"]]
    edt, t60, ms = (heads.index(head) for head in ("EDT (ms)", "T60 (%)", "ms"))
    assert [row[edt] for row in means] == ["**2.00**", "3.38", "4.00", "1.00"]
    assert [row[t60] for row in means] == ["**2.00**", "4.00", "", "1.00"]
    assert [row[ms] for row in means] == ["3.00", "4000", "0.200", ""]


def test_errors_are_drawn_in_units_of_the_floor(result, tmp_path):
    results = [SceneResult.read(result()), SceneResult.read(result(data="hut (simulated)"))]
    panels = {axes.get_title(): axes for axes in figure_of(results).axes if axes.get_visible()}
    assert list(panels) == ["spectral loss", "T60", "EDT", "C50", "DRR", "IACC", "level", "ITD"]

    def drawn(title, label):
        return next(line.get_ydata() for line in panels[title].lines if str(line.get_label()).startswith(label))

    assert_array_equal(drawn("C50", "default level"), [2.0, 2.0])
    assert_array_equal(drawn("EDT", "the same network"), [1.5, 1.5])
    assert_array_equal(drawn("T60", "nearest"), [np.nan, np.nan])
    assert [text.get_text() for text in panels["ITD"].get_xticklabels()] == ["flat", "hut"]
    draw_scenes(results, tmp_path / "scenes.png")
    with Image.open(tmp_path / "scenes.png") as picture:
        assert min(picture.size) > 500


def test_without_naf_there_is_no_remark(result):
    read = SceneResult.read(result(columns={"standard": column("field", "", 1.0), "floor": column("floor", "", 0.5)}))
    assert read.level == "standard"
    assert not [line for line in markdown([read]).splitlines() if line.startswith("-")]


@pytest.mark.parametrize(
    ("changes", "told"),
    [({"columns": {"floor": column("floor", "", 1.0)}}, "no level"), ({"columns": {"x": {}}}, "not what")],
)
def test_what_is_no_result_is_told(result, tmp_path, changes, told):
    with pytest.raises(ResultError, match=told):
        SceneResult.read(result(**changes))
    with pytest.raises(ResultError, match="cannot be read"):
        SceneResult.read(tmp_path / "absent.json")


def test_times_of_pieces_add_up(tmp_path):
    log = tmp_path / "times.jsonl"
    pieces = [("train", 30, 50, -2), ("naf", 60, 60, 0), ("train", 90, 70, 0)]
    log.write_text(
        "".join(
            json.dumps({"step": step, "wall_s": wall, "cpu_s": cpu, "rc": rc}) + "\n" for step, wall, cpu, rc in pieces
        )
    )
    lines = times_markdown({"flat": step_times(log), "hut": step_times(log)[:1]}).splitlines()
    assert lines[0] == "| minutes | train | naf | all |"
    assert lines[2:] == [
        "| flat | 2.0 (2.0) | 1.0 (1.0) | 3.0 (3.0) |",
        "| hut | 2.0 (2.0) |  | 2.0 (2.0) |",
        "| all | 4.0 (4.0) | 1.0 (1.0) | 5.0 (5.0) |",
    ]
    log.write_text("{}\n")
    with pytest.raises(ResultError, match="stopwatch"):
        step_times(log)
