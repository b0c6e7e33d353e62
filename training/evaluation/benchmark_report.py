"""Scores of a benchmark, and definitions, as tables."""

from collections.abc import Iterable, Sequence

from rich.console import Group as Renderables
from rich.table import Table
from rich.text import Text

from training.evaluation.benchmark import Score
from training.evaluation.comparison import Metric
from training.evaluation.literature import METRICS
from training.evaluation.predictions import first
from training.evaluation.report import short

_HEADS = ("error", "by", "mean", "median", "unit", "responses", "failed")


def report(score: Score) -> Renderables:
    """The table for the terminal, with what it is of."""
    table = Table(*_HEADS, title=_title(score), caption="\n".join(_sentences(score)), caption_justify="left")
    for column in table.columns[2:4]:
        column.justify = "right"
    last = ""
    for metric in METRICS:
        if last and metric.quantity != last:
            table.add_section()
        cells = _cells(score, metric)
        table.add_row("" if metric.quantity == last else cells[0], *cells[1:])
        last = metric.quantity
    warning = _warning(score)
    if not warning:
        return Renderables(table)
    loud = Text(warning, style="bold red")
    return Renderables(loud, table, loud)


def markdown(score: Score) -> str:
    """The table as Markdown."""
    warning = _warning(score)
    lines = [
        *([f"**{warning}**", ""] if warning else []),
        f"{_title(score)}. {' '.join(_sentences(score))}",
        "",
        f"| {' | '.join(_HEADS)} |",
        "| --- | --- | ---: | ---: | --- | ---: | ---: |",
        *(f"| {' | '.join(_cells(score, metric))} |" for metric in METRICS),
    ]
    return "\n".join(lines)


def definitions(metrics: Sequence[Metric] = METRICS) -> str:
    """All definitions as Markdown, a heading for each quantity."""
    return "\n".join(_described(metrics))


def _described(metrics: Iterable[Metric]) -> Iterable[str]:
    last = ""
    for metric in metrics:
        if metric.quantity != last:
            yield f"## {metric.quantity[0].upper()}{metric.quantity[1:]}\n"
            last = metric.quantity
        stated = metric.definition
        channels = "; two ears only" if metric.channels > 1 else ""
        yield f"### {metric.label} (`{metric.name}`)\n"
        yield f"- formula: {stated.formula}"
        yield f"- part of the response: {stated.over}"
        yield f"- band: {stated.band}"
        yield f"- unit: {metric.unit or 'none'}{channels}"
        yield f"- failures: {stated.failures}"
        yield f"- source: {stated.source}\n"


def _title(score: Score) -> str:
    count = f"{score.scored} response{'s' if score.scored > 1 else ''}"
    return f"{score.dataset} ({score.data.layout}): {count} at {score.data.scored_rate} Hz"


def _warning(score: Score) -> str:
    if score.comparable:
        return ""
    tested = len(score.data.split.test)
    return (
        f"NOT COMPARABLE: {len(score.missing)} of {tested} predictions are missing ({first(score.missing)}), and the "
        "errors are those of the others only."
    )


def _sentences(score: Score) -> Iterable[str]:
    split = score.data.split
    parts = f"{len(split.train)} responses to learn from, {len(split.test)} to test on"
    yield f"Split: {split.name} ({split.source}), {parts}, {split.digest[:12]}."
    yield from score.notes()
    if score.benchmark is not None:
        yield f"Benchmark {score.benchmark[:12]}: compare with scores of the same benchmark only."


def _cells(score: Score, metric: Metric) -> list[str]:
    summary = score.summaries[metric.name]
    names = [metric.quantity, metric.by]
    if summary is None:
        return [*names, "–", "–", metric.unit, "two ears only", ""]
    values = ["–" if value is None else short(value) for value in (summary.mean, summary.median)]
    return [*names, *values, metric.unit, str(summary.count), str(summary.missing)]
