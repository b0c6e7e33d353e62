"""The page "Where a listener-second goes" is filled from files of measured costs."""

import json

import pytest

from benchmarks import listener_second
from benchmarks.record import Result
from server.bench import costs
from server.bench.capacity import TERMS
from server.core.errors import NafirError
from tests.bench.test_capacity import MEASURED

OTHER = MEASURED.model_copy(update={"scene": "bench"})


def test_every_part_has_a_row_and_the_last_is_their_sum(tmp_path, monkeypatch):
    files = [tmp_path / "a.json", tmp_path / "b.json"]
    for path, measured in zip(files, (MEASURED, OTHER), strict=True):
        costs.write_costs(path, measured)
    monkeypatch.setattr(listener_second, "PATH", tmp_path / "result.json")
    listener_second.main([*map(str, files), "--note", "idle"])
    result = Result.read(tmp_path / "result.json")
    assert str(result.host) == "P; AVX2; one core; idle"
    assert result.command.count("nafir bench costs --scene") == 2
    assert result.tables.keys() == {"flat", "bench", "capacity", "crowds", "limits"}
    table = result.tables["flat"]
    assert [column.title for column in table.columns[2:]] == ["2 × 1", "9 × 1", "2 × 16", "9 × 16"]
    *parts, whole, _ = table.rows
    assert [row[0] for row in parts] == list(TERMS)
    for at in range(2, 6):
        assert sum(float(str(row[at])) for row in parts) == pytest.approx(float(str(whole[at])), rel=0.02)
    for name in result.tables:
        assert result.tables[name].markdown()
    json.loads((tmp_path / "result.json").read_text())


def test_a_run_that_was_late_is_no_column_unless_all_were():
    *others, last = MEASURED.runs
    late = MEASURED.model_copy(update={"runs": (*others, last.model_copy(update={"late_share": 0.3}))})
    titles = [column.title for column in listener_second.result_of([late]).tables["flat"].columns[2:]]
    assert titles == ["2 × 1", "9 × 1", "2 × 16", "5 × 16"]
    all_late = tuple(run.model_copy(update={"late_share": 0.3}) for run in MEASURED.runs)
    table = listener_second.result_of([MEASURED.model_copy(update={"runs": all_late})]).tables["flat"]
    assert [column.title for column in table.columns[2:]] == ["2 × 1", "9 × 1", "2 × 16", "9 × 16"]


@pytest.mark.parametrize(
    ("other", "field"),
    [
        (OTHER.model_copy(update={"processor": "Q"}), "processor"),
        (OTHER.model_copy(update={"commit": "0123abc"}), "commit"),
        (MEASURED, "scene"),
    ],
)
def test_files_that_do_not_belong_together_are_refused(other, field):
    with pytest.raises(NafirError, match=field):
        listener_second.result_of([MEASURED, other])
