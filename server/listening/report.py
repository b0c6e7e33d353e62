"""The results of a listening test as tables for a terminal."""

from collections.abc import Iterator

from rich.console import RenderableType
from rich.table import Table

from server.listening.analysis import Comparison, Results
from server.listening.statistics import Interval, Share

_PARTS = {
    "test": "nearer to the truth",
    "hidden-reference": "taken for the truth",
    "anchor": "check: truth over anchor",
}


def report(results: Results) -> Iterator[RenderableType]:
    """Tables, and lines of text between them."""
    asked = "choices" if results.kind == "choice" else "ratings"
    yield f"{results.name}: {asked} of {results.counted} listeners count, of {results.begun} who began"
    for rule in results.rules:
        yield f"  counts who: {rule}"
    if (screening := results.screening) is not None:
        yield (
            f"  headphones: {screening.first_try} at the first try, {screening.second_try} at the second, "
            f"{screening.failed} not, {screening.undecided} undecided"
        )
    for each in results.excluded:
        yield f"  does not count: {each.listener}, {each.reason}"
    if not results.counted:
        yield "nobody's answers count yet"
        return
    if results.kind == "choice":
        yield _comparisons(results)
        if len(results.won) > 2:
            yield _won(results)
        return
    yield _rated(results)
    if (agreement := results.agreement) is not None:
        yield (
            f"ratings and errors in JND: Spearman's rho {agreement.rho:.2f} over {agreement.count} levels, "
            f"p {_p(agreement.p, equals='= ')} (-1: ears and axis agree fully)"
        )


def _comparisons(results: Results) -> Table:
    table = Table(
        "comparison", "asked", "chosen", "share", "Wilson 95 %", "Clopper-Pearson", "over listeners", "p", "Holm"
    )
    for each in results.comparisons:
        table.add_row(_title(each), _PARTS[each.part], *_cells(each.result), *_p_cells(each))
        if (paper := each.published) is not None:
            first, second = paper.over
            title = f"  {paper.source}: {first} over {second}, {paper.listeners} listeners, {paper.places} places"
            table.add_row(title, _PARTS["test"], *_cells(paper.result), _p(paper.result.p), "", style="dim")
    return table


def _won(results: Results) -> Table:
    table = Table("method", "chosen", "share of its comparisons", "Wilson 95 %", "Clopper-Pearson", "over listeners")
    for each in results.won:
        table.add_row(each.method, *_cells(each.result))
    return table


def _rated(results: Results) -> Table:
    table = Table("method", "kind", "median", "95 % over listeners", "quartiles", "ratings", "error (JND)")
    for each in results.rated:
        spread = each.result
        interval = "" if spread.interval is None else _between(spread.interval, 1.0)
        jnd = "" if each.jnd is None else f"{each.jnd:.2f}"
        quartiles = _between(spread.quartiles, 1.0)
        table.add_row(each.method, each.kind, f"{spread.median:.0f}", interval, quartiles, f"{spread.ratings}", jnd)
    return table


def _title(each: Comparison) -> str:
    return f"{each.first} over {each.second}"


def _cells(share: Share) -> tuple[str, ...]:
    over = "" if share.over_listeners is None else _between(share.over_listeners)
    counted = f"{share.count} of {share.trials}"
    return counted, f"{100 * share.share:.2f} %", _between(share.wilson), _between(share.clopper_pearson), over


def _p_cells(each: Comparison) -> tuple[str, str]:
    return _p(each.result.p), "" if each.p_corrected is None else _p(each.p_corrected)


def _between(interval: Interval, factor: float = 100.0) -> str:
    low, high = interval
    return f"{factor * low:.0f} to {factor * high:.0f}"


def _p(p: float, equals: str = "") -> str:
    return "< 0.001" if p < 0.001 else f"{equals}{p:.3f}"
