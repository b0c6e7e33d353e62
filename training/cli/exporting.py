"""`nafir-train export`: trained fields as a scene bundle."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from server.core.errors import NafirError
from server.core.numerals import parse_integer
from training.cli.options import Folder, progress_bar


def export(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Run folders from train, all of one scene, the default first; for the nearest response, shaped, the "
            "folder of imported responses itself."
        ),
    ],
    output: Folder,
    data: Annotated[Path | None, typer.Option(help="Dataset folder, if it has moved since training.")] = None,
    precision: Annotated[str, typer.Option(help="float32 or int8, or both, separated by a comma.")] = "float32",
    ranks: Annotated[str, typer.Option(help="Lower ranks, 64,32 say, to write factorised fields at too.")] = "",
    exact_tables: Annotated[
        bool, typer.Option("--exact-tables", help="Add every naf once more, with less arithmetic for the same numbers.")
    ] = False,
    accept: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LAW=REASON",
            help="Offer the scene although its fields break a law of nafir check, named as in nafir check --json; the "
            "bundle keeps the reason. Once for each law.",
        ),
    ] = None,
) -> None:
    """Write finished runs as the fields of a scene bundle. Every graph is checked against torch, and by nafir check."""
    from training.bundling.export import PRECISIONS
    from training.bundling.export import export as export_bundle
    from training.data.responses import FILE
    from training.learning.runs import dataset_folder
    from training.simulation.responses import open_responses

    chosen = [known for name in precision.split(",") for known in PRECISIONS if known == name.strip()]
    if len(chosen) != len(precision.split(",")):
        raise typer.BadParameter(f"knows {', '.join(PRECISIONS)}", param_hint="--precision")
    lower = [_rank(text) for text in ranks.split(",") if ranks]
    accepted = _accepted(accept or ())
    responses = open_responses(data or (runs[0] if (runs[0] / FILE).is_file() else dataset_folder(runs[0])))
    with progress_bar() as progress:
        bundle = export_bundle(
            responses,
            runs,
            output,
            precisions=chosen,
            ranks=lower,
            exact_tables=exact_tables,
            accepted=accepted,
            progress=progress,
        )
    for entry in bundle.manifest.accepted:
        typer.echo(f"{output}: breaks the law {entry.law}, accepted: {entry.reason}")
    for name in accepted.keys() - {entry.law for entry in bundle.manifest.accepted}:
        typer.echo(f"{output}: keeps the law {name}; there was nothing to accept")
    size = sum(path.stat().st_size for path in output.iterdir())
    fields = ", ".join(bundle.manifest.fields)
    typer.echo(f"{output}: scene {bundle.id}, {fields}, {size / 1e6:.1f} MB, digest {bundle.digest[:12]}")


def _rank(text: str) -> int:
    try:
        rank = parse_integer(text)
    except ValueError as exc:
        raise NafirError(f"--ranks: {exc}") from exc
    if rank < 1:
        raise NafirError(f"--ranks: {rank} is not above zero")
    return rank


def _accepted(entries: Sequence[str]) -> dict[str, str]:
    """Reasons by law. Raises NafirError if a law is named twice."""
    accepted: dict[str, str] = {}
    for law, reason in map(_law_and_reason, entries):
        if law in accepted:
            raise NafirError(f"--accept: two reasons for {law}: give one")
        accepted[law] = reason
    return accepted


def _law_and_reason(entry: str) -> tuple[str, str]:
    law, separator, reason = entry.partition("=")
    if not separator:
        raise typer.BadParameter(f"{entry!r}: is not LAW=REASON", param_hint="--accept")
    return law.strip(), reason.strip()
