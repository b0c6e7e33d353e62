"""An evaluation becomes the table of its page: a row for each metric, beside baselines and the floor."""

from benchmarks.errors import METRICS, result_of
from benchmarks.record import Host, Result

UNITS = {"t60": "%", "edt": "ms", "spectral_loss": "ln", "iacc": ""}


def column(kind: str, mean: float | None, count: int = 80):
    times = None if mean is None else mean / 2
    return {"kind": kind, "metrics": {name: {"mean": mean, "count": count, "times_floor": times} for name in METRICS}}


def test_each_metric_has_its_errors_in_units_and_how_many_floors_they_are() -> None:
    evaluation = {
        "metrics": [{"name": name, "label": name.upper(), "unit": UNITS.get(name, "dB")} for name in METRICS],
        "columns": {
            "standard": column("field", 1.4614, 14),
            "linear-aligned": column("baseline", None),
            "nearest": column("baseline", 145.56),
            "floor": column("floor", 2),
        },
    }
    host = Host(processor="P", instruction_set="AVX2", cores=2)
    result = result_of(evaluation, host=host, command="c", commit="0123abc", facts={"Data": "d"})
    assert Result.model_validate_json(result.model_dump_json()) == result
    table = result.tables["errors"]
    assert table.column("times the floor") == [0.73] * len(METRICS)
    lines = table.markdown().splitlines()
    assert lines[0] == "| | rendered | linear aligned | nearest | floor | times the floor | responses |"
    assert lines[2] == "| T60 | 1.5 % | | 150 % | 2.0 % | 0.73 | 14 |"
    assert lines[2 + METRICS.index("iacc")] == "| IACC | 1.5 | | 150 | 2.0 | 0.73 | 14 |"
