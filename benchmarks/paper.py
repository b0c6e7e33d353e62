"""Gathers what `make paper` measured into `benchmarks/results/paper.json`: `python -m benchmarks.paper RUNS [COMMAND]`.

RUNS has a folder for each scene with `paper-table.json` (`nafir-train evaluate --output`) and `probe.json`
(`nafir-train probe-emitters --json`), and the folders `fractions` and `office`. What is missing is left out: the page
then says that it was not measured. No number is written here; those of the paper are in
`training.evaluation.published`. COMMAND tells how all was measured, if not by `make paper`.
"""

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, Final

from benchmarks.record import FOLDER, Cell, Column, Host, Result, Table, Value
from server.bench.history import Run
from training.evaluation.paper_metrics import INTERAURAL_LAG, SPECTRAL_LOSS_OF_PAPER
from training.evaluation.published import PAPER_FIGURES, published_table
from training.evaluation.report import short
from training.trials.fractions import ALL, Fractions
from training.trials.fractions_figure import spreads

TABLE, PROBE, OFFICE, FRACTIONS = "paper-table.json", "probe.json", "office", "fractions"
_NOT_MEASURED = "not measured"
_UNREAD = "number not at hand"
_SHOWN: Final = {
    SPECTRAL_LOSS_OF_PAPER.name: "spectral loss, as the paper",
    "spectral_loss": "ours",
    "t60": "T60 (%)",
    INTERAURAL_LAG.name: "IACC lag, as the paper (us)",
    "iacc": "IACC, ours",
    "drr": "DRR (dB)",
    "c50": "C50 (dB)",
}
_ELSEWHERE: Final = {
    "cross-modal": (
        "PSNR of NeRF alone and trained with the field, 75 images",
        ("psnr-75-nerf", "psnr-75-nerf-naf"),
        "small pictures of our own flats",
    ),
    "listening-test": ("people choose the field over AAC, nearest", ("preference",), "other rooms and other people"),
}
"""Rows that other commands measure, by their file below benchmarks/results/: subject, the paper's, why they differ."""


def gather(runs: Path, results: Path = FOLDER, command: str = "`make paper`") -> Result:
    """The result of all that is in `runs`. `results` is where other commands keep theirs."""
    tables = dict(_tables(runs))
    tables["claims"] = _claims(runs, tables, results)
    fractions = _fractions(runs)
    run = Run.now("make paper", {}, ())
    return Result(
        host=Host(
            processor=run.host.processor,
            instruction_set=run.host.instruction_set,
            cores=run.host.cores or "unknown",
            note="a shared machine",
        ),
        date=datetime.now(UTC).date().isoformat(),
        commit=run.commit,
        command=command,
        facts=_facts(runs),
        tables=tables,
        plots={} if fractions is None else {"paper-fractions.png": "fractions"},
        values={} if fractions is None else {"fractions": fractions.to_json()},
    )


def _scenes(runs: Path, file: str) -> dict[str, dict[str, Any]]:
    return {path.parent.name: json.loads(path.read_text()) for path in sorted(runs.glob(f"*/{file}"))}


def _fractions(runs: Path) -> Fractions | None:
    path = runs / FRACTIONS / ALL
    return Fractions.from_json(json.loads(path.read_text())) if path.exists() else None


def _facts(runs: Path) -> dict[str, str]:
    facts = {}
    for scene, found in _scenes(runs, TABLE).items():
        facts[f"Table of {scene}"] = (
            f"{found['pairs']} of {found['held_out_pairs']} held-out pairs at {found['yaws']} orientation"
        )
    for scene, found in _scenes(runs, PROBE).items():
        facts[f"Probe of {scene}"] = (
            f"run {found['run']}; fitted at {found['fitted_places']} places, tested at {found['cells']}, "
            f"{found['spacing_m']:g} m apart; features averaged over {found['points']} points"
        )
    if (fractions := _fractions(runs)) is not None:
        effort = fractions.effort
        seeds = len({each.trial.seed for each in fractions.scored})
        facts["Fractions"] = (
            f"{fractions.data}: {effort.epochs} passes over all pairs at {effort.points} points a response for naf, "
            f"{seeds} seeds, {effort.pairs} held-out pairs scored"
        )
    return facts


def _tables(runs: Path) -> Iterator[tuple[str, Table]]:
    if scenes := _scenes(runs, TABLE):
        yield "errors", _errors(scenes)
    if scenes := _scenes(runs, PROBE):
        yield "probe", _probe(scenes)
    office = runs / OFFICE / "table.json"
    if office.exists():
        yield "office", _errors({OFFICE: json.loads(office.read_text())})
    if (fractions := _fractions(runs)) is not None:
        yield "fractions", _fractions_table(fractions)


def _errors(scenes: Mapping[str, Mapping[str, Any]]) -> Table:
    """A row for each scene and method, with published T60 and C50 errors of other data beside ours."""
    rows = []
    for scene, found in scenes.items():
        published = published_table(simulated="simulated" in found["data"]).errors
        for name, column in found["columns"].items():
            means = {metric: summary["mean"] for metric, summary in column["metrics"].items()}
            printed = published.get(column["method"], {}).get("t60")
            size = column["storage_bytes"]
            rows.append(
                (
                    scene,
                    name,
                    *(_number(means.get(metric)) for metric in _SHOWN),
                    _number(printed),
                    _number(None if size is None else size / 1e6),
                )
            )
    numbers = (*_SHOWN.values(), "T60 elsewhere (%)", "MB")
    return Table(
        columns=(
            Column(title="scene"),
            Column(title="method"),
            *(Column(title=each, is_number=True) for each in numbers),
        ),
        rows=tuple(rows),
    )


def _probe(scenes: Mapping[str, Mapping[str, Any]]) -> Table:
    """The share of the variance that is explained, in percent, the best in bold."""
    names = list(dict.fromkeys(name for found in scenes.values() for name in found["explained_variance"]))
    rows = []
    for scene, found in scenes.items():
        shares = found["explained_variance"]
        best = max(shares.values())
        rows.append((scene, *(_percent(shares.get(name), best) for name in names)))
    columns = (Column(title="scene"), *(Column(title=f"{name} (%)", is_number=True) for name in names))
    return Table(columns=columns, rows=tuple(rows))


def _percent(share: float | None, best: float) -> Cell:
    return None if share is None else Value(value=Decimal(f"{100 * share:.1f}"), is_best=share == best)


def _fractions_table(fractions: Fractions) -> Table:
    metrics = {"spectral_loss": "spectral loss", "t60": "T60 (%)", "c50": "C50 (dB)"}
    found = {metric: spreads(fractions, metric) for metric in metrics}
    rows = []
    for field, by_percent in found["spectral_loss"].items():
        for percent, (*_, seeds) in by_percent.items():
            cells = [_with_deviation(found[metric].get(field, {}).get(percent)) for metric in metrics]
            rows.append((field, f"{percent:g}", seeds, *cells))
    heads = ("pairs (%)", "seeds", *metrics.values())
    return Table(
        columns=(Column(title="field"), *(Column(title=head, is_number=True) for head in heads)), rows=tuple(rows)
    )


def _with_deviation(found: tuple[float, float, int] | None) -> str | None:
    if found is None:
        return None
    mean, deviation, seeds = found
    return f"{mean:.3g} ± {deviation:.2g}" if seeds > 1 else f"{mean:.3g}"


def _claims(runs: Path, tables: Mapping[str, Table], results: Path) -> Table:
    """What the paper says, what we found, and why the two differ, row by row."""
    at_hand = {name: f"{figure.value:g} {figure.unit}" for name, figure in PAPER_FIGURES.items()}
    errors = "[below](#errors)" if "errors" in tables else _NOT_MEASURED
    curve = "[below](#fractions)" if "fractions" in tables else _NOT_MEASURED
    office = "[below](#a-measured-room)" if "office" in tables else _NOT_MEASURED
    claims = [
        ("errors of all methods, storage", _UNREAD, errors, "other rooms, fewer pairs"),
        ("T60 error of the network of waveforms", at_hand["t60-time-domain"], _NOT_MEASURED, ""),
        (
            "features tell walls better than MFCC",
            _UNREAD,
            _probe_claim(runs),
            "the paper has no untrained control; we average fewer points",
        ),
        (
            "the grid helps, more so with few pairs",
            _UNREAD,
            curve,
            "steps and points are fewer by orders of magnitude",
        ),
        (
            "the network beats Helmholtz ridge regression in a measured room",
            _UNREAD,
            office,
            "another room, far fewer responses, less training",
        ),
    ]
    rows: list[tuple[Cell, ...]] = [
        (subject, told, ours, why if ours != _NOT_MEASURED else None) for subject, told, ours, why in claims
    ]
    for name, (subject, figures, why) in _ELSEWHERE.items():
        told = " and ".join(at_hand[figure] for figure in figures)
        is_there = (results / f"{name}.json").exists()
        rows.append((subject, told, f"[there]({name}.md)" if is_there else _NOT_MEASURED, why if is_there else None))
    columns = (Column(title="what"), Column(title="the paper"), Column(title="ours"), Column(title="why they differ"))
    return Table(columns=columns, rows=tuple(rows))


def _probe_claim(runs: Path) -> str:
    """On how many scenes the trained network explains more than each control."""
    from training.evaluation.emitter_probe import MFCC, TRAINED, UNTRAINED

    scenes = [found["explained_variance"] for found in _scenes(runs, PROBE).values()]
    if not scenes:
        return _NOT_MEASURED
    over = {control: sum(shares[TRAINED] > shares[control] for shares in scenes) for control in (MFCC, UNTRAINED)}
    told = ", ".join(f"{control} on {wins} of {len(scenes)}" for control, wins in over.items())
    return f"explains more than {told} scenes ([below](#probe))"


def _number(value: float | None) -> Cell:
    return None if value is None else Decimal(short(value))


def main(arguments: Sequence[str]) -> None:
    result = gather(Path(arguments[0]), FOLDER, *arguments[1:2])
    text = result.model_dump_json(indent=1, exclude_defaults=True)
    (FOLDER / "paper.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
