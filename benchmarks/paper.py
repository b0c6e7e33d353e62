"""Gathers what `make paper` measured into `benchmarks/results/paper.json`:
`python -m benchmarks.paper RUNS [COMMAND [NAME COMMIT HOST]]`.

RUNS has a folder for each scene with `paper-table.json` (`nafir-train evaluate --output`) and `probe.json`
(`nafir-train probe-emitters --json`), the folders `fractions` and `office`, and `networks.json`
(`training.trials.networks_to_the_end`). What is missing is left out: the page then says that it was not measured. No
number is written here; those of the paper are in `training.evaluation.published`. COMMAND tells how all was measured,
if not by `make paper`.

What another machine measured goes to `NAME.json`, one of `PARTS`. COMMIT is that of the code that measured, and HOST a
JSON file with the fields of `benchmarks.record.Host`. The claims in `paper.json` are of all parts.
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

PARTS: Final = ("paper", "paper-networks")
NETWORKS = "networks.json"
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
        "small pictures of our own flat and few steps; the grid without sound was not run",
    ),
    "listening-test": ("people choose the field over AAC, nearest", ("preference",), "other rooms and other people"),
}
"""Rows that other commands measure, by their file below benchmarks/results/: subject, the paper's, why they differ."""


def gather(
    runs: Path,
    command: str = "`make paper`",
    *,
    commit: str | None = None,
    host: Host | None = None,
) -> Result:
    """The result of all that is in `runs`, but for the claims; measured by this machine and code, or by `host` and
    `commit`."""
    run = Run.now("make paper", {}, ())
    here = Host(
        processor=run.host.processor,
        instruction_set=run.host.instruction_set,
        cores=run.host.cores or "unknown",
        note="a shared machine",
    )
    plots, values = {}, {}
    if (fractions := _fractions(runs)) is not None:
        plots["paper-fractions.png"], values["fractions"] = "fractions", fractions.to_json()
    if networks := _networks(runs):
        plots["paper-networks.png"], values["networks"] = "held_back_losses", networks
    return Result(
        host=host or here,
        date=datetime.now(UTC).date().isoformat(),
        commit=commit or run.commit,
        command=command,
        facts=_facts(runs),
        tables=dict(_tables(runs)),
        plots=plots,
        values=values,
    )


def with_claims(paper: Result, others: Sequence[Result], results: Path = FOLDER) -> Result:
    """The result with the table of claims, by the tables of all parts; other commands keep theirs in `results`."""
    tables = {name: table for part in (paper, *others) for name, table in part.tables.items()}
    probes = [part.tables["probe"] for part in (paper, *others) if "probe" in part.tables]
    return paper.model_copy(update={"tables": {**paper.tables, "claims": _claims(tables, probes, results)}})


def _scenes(runs: Path, file: str) -> dict[str, dict[str, Any]]:
    return {path.parent.name: json.loads(path.read_text()) for path in sorted(runs.glob(f"*/{file}"))}


def _fractions(runs: Path) -> Fractions | None:
    path = runs / FRACTIONS / ALL
    return Fractions.from_json(json.loads(path.read_text())) if path.exists() else None


def _networks(runs: Path) -> dict[str, dict[str, Any]]:
    """Records and curves of networks, by scene and network."""
    path = runs / NETWORKS
    return dict(json.loads(path.read_text())) if path.exists() else {}


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
        has_naf = any(each.trial.field.startswith("naf") for each in fractions.scored)
        points = f" at {effort.points} points a response for naf" if has_naf else ""
        facts["Fractions"] = (
            f"{fractions.data}: as many steps as {effort.epochs} passes over all pairs{points}, {seeds} seeds, "
            f"{effort.pairs} held-out pairs scored"
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
    if networks := _networks(runs):
        yield "networks", _networks_table(networks)


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


def _networks_table(networks: Mapping[str, Mapping[str, Any]]) -> Table:
    """How far each network was trained, its held-back loss, the least one on the way and that of the mean."""
    rows = []
    for scene, of_scene in networks.items():
        for field, record in of_scene.items():
            losses = [record["held_back_loss"], min(loss for _, loss in record["curve"]), record["mean_loss"]]
            rows.append(
                (
                    scene,
                    field,
                    record["steps"],
                    _number(record["epochs"]),
                    Decimal(f"{100 * record['recipe_share']:.3g}"),
                    *(Decimal(f"{loss:.4f}") for loss in losses),
                    f"{record['slope_per_doubling']:+.4f}",
                )
            )
    numbers = (
        "steps",
        "epochs",
        "of the recipe (%)",
        "held-back loss",
        "least on the way",
        "the training set's mean",
        "per doubling of steps, at the end",
    )
    columns = (
        Column(title="scene"),
        Column(title="network"),
        *(Column(title=each, is_number=True) for each in numbers),
    )
    return Table(columns=columns, rows=tuple(rows))


def _with_deviation(found: tuple[float, float, int] | None) -> str | None:
    if found is None:
        return None
    mean, deviation, seeds = found
    return f"{mean:.3g} ± {deviation:.2g}" if seeds > 1 else f"{mean:.3g}"


def _claims(tables: Mapping[str, Table], probes: Sequence[Table], results: Path) -> Table:
    """What the paper says, what we found, and why the two differ, row by row."""
    at_hand = {name: f"{figure.value:g} {figure.unit}" for name, figure in PAPER_FIGURES.items()}
    errors = "[below](#errors)" if "errors" in tables else _NOT_MEASURED
    office = "[below](#a-measured-room)" if "office" in tables else _NOT_MEASURED
    claims = [
        ("errors of all methods, storage", _UNREAD, errors, "other rooms, fewer pairs"),
        ("T60 error of the network of waveforms", at_hand["t60-time-domain"], _NOT_MEASURED, ""),
        (
            "features tell walls better than MFCC",
            _UNREAD,
            _probe_claim(probes),
            "the paper has no untrained control; we average fewer points",
        ),
        (
            "the grid helps, more so with few pairs",
            _UNREAD,
            _grid_claim(tables),
            "another measure, and fewer steps",
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
        ours = _found(results, name) + f"[there]({name}.md)" if is_there else _NOT_MEASURED
        rows.append((subject, told, ours, why if is_there else None))
    columns = (Column(title="what"), Column(title="the paper"), Column(title="ours"), Column(title="why they differ"))
    return Table(columns=columns, rows=tuple(rows))


def _probe_claim(probes: Sequence[Table]) -> str:
    """On how many scenes the trained network explains more than each control."""
    from training.evaluation.emitter_probe import MFCC, TRAINED, UNTRAINED

    if not probes:
        return _NOT_MEASURED
    explained = {
        name: [share for probe in probes for share in probe.column(f"{name} (%)")]
        for name in (TRAINED, UNTRAINED, MFCC)
    }
    trained = explained[TRAINED]
    wins = {
        control: sum((one or 0.0) > (other or 0.0) for one, other in zip(trained, explained[control], strict=True))
        for control in (MFCC, UNTRAINED)
    }
    told = ", ".join(f"{control} on {number} of {len(trained)}" for control, number in wins.items())
    return f"explains more than {told} scenes ([below](#probe))"


def _grid_claim(tables: Mapping[str, Table]) -> str:
    """Held-back losses with and without grid on all pairs, and a link to the fractions if both were trained on them."""
    found = []
    if (table := tables.get("networks")) is not None:
        losses = {(row[0], row[1]): row[5] for row in table.rows}
        found += [
            f"held-back loss on all pairs of {scene}: {losses[scene, 'naf']} with and "
            f"{losses[scene, 'naf-no-grid']} without grid ([below](#networks-on-a-gpu))"
            for scene in dict.fromkeys(scene for scene, _ in losses)
            if {(scene, "naf"), (scene, "naf-no-grid")} <= set(losses)
        ]
    if (table := tables.get("fractions")) is not None and {"naf", "naf-no-grid"} <= {row[0] for row in table.rows}:
        found.append("[by fractions](#fractions)")
    return "; ".join(found) or _NOT_MEASURED


def _found(results: Path, name: str) -> str:
    """The two numbers of PSNR with the fewest images, if they are there."""
    if name != "cross-modal":
        return ""
    table = Result.model_validate_json((results / f"{name}.json").read_text(encoding="utf-8")).tables["means"]
    measured = [row for row in table.rows if row[3] is not None]
    named = {row[1]: row[3] for row in measured if row[0] == measured[0][0]}
    psnrs = [f"{found.value} dB" for title in ("NeRF", "NeRF + NAF") if isinstance(found := named.get(title), Value)]
    return " and ".join(psnrs) + ", " if len(psnrs) == 2 else ""


def _number(value: float | None) -> Cell:
    return None if value is None else Decimal(short(value))


def main(arguments: Sequence[str], results: Path = FOLDER) -> None:
    runs, *others = arguments
    name = others[1] if len(others) > 1 else PARTS[0]
    commit = others[2] if len(others) > 2 else None
    host = Host.model_validate_json(Path(others[3]).read_text(encoding="utf-8")) if len(others) > 3 else None
    _write(results, name, gather(Path(runs), *others[:1], commit=commit, host=host))
    parts = [
        Result.model_validate_json((results / f"{part}.json").read_text(encoding="utf-8"))
        for part in PARTS
        if (results / f"{part}.json").exists()
    ]
    _write(results, PARTS[0], with_claims(parts[0], parts[1:], results))


def _write(results: Path, name: str, result: Result) -> None:
    text = result.model_dump_json(indent=1, exclude_defaults=True)
    (results / f"{name}.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
