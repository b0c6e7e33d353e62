"""The tables of an evaluation, with a row per method and a column per metric, as in Luo et al. (NeurIPS 2022)."""

from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from server.acoustics.metrics import Metric
from training.evaluation.evaluate import METRICS, ONE_SIMULATION, RATED, Evaluation, Result
from training.evaluation.published import PublishedTable

_PUBLISHED_OTHERS = ("inras", "neraf", "minaf", "avr")


def report(evaluation: Evaluation, published: PublishedTable) -> Table:
    """The table for the terminal: mean errors and, dimmed, numbers of missing entries. Bold: the best of fields and
    baselines, and every method that is not significantly worse. Green: a field that beats every baseline."""
    table = Table(title=_title(evaluation), caption=_caption(evaluation, published), caption_justify="left")
    table.add_column("method")
    for metric in METRICS:
        table.add_column(_head(metric), justify="right")
    table.add_column("storage\n(MB)", justify="right")
    table.add_column("time\n(ms)", justify="right")
    best = {metric.name: _best(evaluation, metric) for metric in METRICS}
    for result in evaluation.results:
        cells = [_cell(evaluation, result, metric, result.name in best[metric.name]) for metric in METRICS]
        table.add_row(result.name, *cells, _storage(result), _time(result), end_section=not _printed(result, published))
        if _printed(result, published):
            table.add_row(
                Text("  published", style="dim"), *_published_cells(published, result.method), "", "", end_section=True
            )
    for method in _PUBLISHED_OTHERS:
        if method in published.errors:
            table.add_row(Text(f"{method}, published", style="dim"), *_published_cells(published, method), "", "")
    for sentence in trained(evaluation):
        table.caption = f"{table.caption}\n{sentence}"
    return table


def trained(evaluation: Evaluation) -> list[str]:
    """A sentence for each network of the table: how far it was trained, and whether its loss was still falling."""
    records = {result.training.field: result.training for result in evaluation.results if result.training is not None}
    return [f"{name}: {record.sentence()}." for name, record in records.items()]


def markdown(evaluation: Evaluation, published: PublishedTable) -> str:
    """The table as Markdown. Published figures follow ours in parentheses; missing entries appear as `(n missing)`."""
    lines = [
        f"{_title(evaluation)}. {_caption(evaluation, published)}",
        "",
        "| method | " + " | ".join(" ".join(_head(metric).split()) for metric in METRICS) + " | storage (MB) | ms |",
        "| --- |" + " ---: |" * (len(METRICS) + 2),
    ]
    best = {metric.name: _best(evaluation, metric) for metric in METRICS}
    for result in evaluation.results:
        cells = []
        for metric in METRICS:
            cell = _figure(result, metric)
            if result.summaries[metric.name].mean is not None and result.name in best[metric.name]:
                cell = f"**{cell}**"
            if (printed := published.errors.get(result.method, {}).get(metric.name)) is not None:
                cell += f" ({printed:.3g})"
            if (missing := _unexpected(evaluation, result, metric)) > 0:
                cell += f" ({missing} missing)"
            cells.append(cell)
        lines.append(f"| {result.name} | " + " | ".join([*cells, _storage(result), _time(result)]) + " |")
    remarks = [f"- {sentence}" for sentence in trained(evaluation)]
    return "\n".join([*lines, *(["", *remarks] if remarks else [])])


def _title(evaluation: Evaluation) -> str:
    drawn = "" if evaluation.pairs == evaluation.held_out else f" drawn from {evaluation.held_out}"
    heads = f"{evaluation.yaws} orientations each" if evaluation.yaws > 1 else "one orientation each"
    return f"{evaluation.data}: {evaluation.pairs} held-out pairs{drawn} ({evaluation.visible_pairs} in sight), {heads}"


def _caption(evaluation: Evaluation, published: PublishedTable) -> str:
    return " ".join(_sentences(evaluation, published))


def _sentences(evaluation: Evaluation, published: PublishedTable) -> Iterator[str]:
    yield "Mean errors; bold: the best method, and all that are within two standard errors of the difference from it."
    yield "DRR and ITD are of pairs in sight."
    if evaluation.channels == 1:
        yield "One microphone: nothing to compare between ears."
    if evaluation.draws > 1:
        yield f"Parameters are compared with medians of {evaluation.draws} more simulations, spectra with one."
        yield f"{ONE_SIMULATION.capitalize()}: that one, compared with those medians."
    if evaluation.floor is not None:
        yield "Floor: what two simulations of the same pairs differ by."
    else:
        yield "No pair was measured twice, so the floor is unknown."
    if evaluation.left_out:
        yield f"{evaluation.left_out} pairs lack an orientation and are left out."
    yield f"Published figures are of other data ({published.data}): {published.source}."


def _head(metric: Metric) -> str:
    return f"{metric.label}\n({metric.unit})" if metric.unit else f"{metric.label}\n"


def _best(evaluation: Evaluation, metric: Metric) -> set[str]:
    """The method with the least mean error, and those that are not significantly worse."""
    means = {
        result.name: mean
        for result in evaluation.results
        if result.kind in RATED and (mean := result.summaries[metric.name].mean) is not None
    }
    least = min(means, key=means.__getitem__, default=None)
    return {name for name in means if least not in evaluation.of(name).surpassed_by[metric.name]}


def _cell(evaluation: Evaluation, result: Result, metric: Metric, is_best: bool) -> Text:
    text = Text(_figure(result, metric))
    if is_best:
        text.stylize("bold")
    baselines = evaluation.baselines
    if result.kind == "field" and baselines and len(result.beats[metric.name]) == len(baselines):
        text.stylize("green")
    if missing := _unexpected(evaluation, result, metric):
        text.append(f"\n{missing} missing", style="dim")
    return text


def _figure(result: Result, metric: Metric) -> str:
    mean = result.summaries[metric.name].mean
    return "–" if mean is None else short(mean)


def _unexpected(evaluation: Evaluation, result: Result, metric: Metric) -> int:
    """The number of missing entries, except those that every method lacks because there is no direct sound or no second
    ear."""
    summary = result.summaries[metric.name]
    if summary.count == 0:
        return 0
    hidden = (evaluation.pairs - evaluation.visible_pairs) * evaluation.yaws if metric.needs_direct_sound else 0
    return summary.missing - hidden


def _printed(result: Result, published: PublishedTable) -> bool:
    return result.method in published.errors


def _published_cells(published: PublishedTable, method: str) -> list[Text]:
    errors = published.errors[method]
    return [Text(f"{errors[metric.name]:.3g}" if metric.name in errors else "", style="dim") for metric in METRICS]


def _storage(result: Result) -> str:
    return "" if result.storage_bytes is None else short(result.storage_bytes / 1e6)


def _time(result: Result) -> str:
    return "" if result.ms is None else short(result.ms)


def short(value: float) -> str:
    """The value with three significant digits, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 99.95 else f"{value:#.3g}".rstrip(".")
