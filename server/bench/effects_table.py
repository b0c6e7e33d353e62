"""Tables of the effects benchmark."""

from typing import Any

from server.planning.catalogue import CATALOGUE

_HEADINGS = (
    "situation",
    "on",
    "plan us",
    "all on us",
    "all off us",
    "plan / sum of what is on",
    "largest error JND",
    "least that is on JND",
)


def terminal_rows(measured: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows short enough for a terminal, with the number of effects that are on instead of their names."""
    return [
        {
            "situation": row["situation"],
            "on": f"{len(row['on'])}/{len(CATALOGUE)}",
            "plan": row["plan_us"],
            "all": row["all_us"],
            "none": row["none_us"],
            "ratio": row["ratio"],
            "error": f"{row['error_jnd']:.2f} {row['error_in']}",
            "least on": f"{row['least_jnd']:.2f} {row['least_of']}",
        }
        for row in measured
    ]


def markdown_table(measured: list[dict[str, Any]]) -> str:
    return "\n".join([_line(_HEADINGS), _line(["---"] * len(_HEADINGS)), *(_line(_cells(row)) for row in measured)])


def _cells(row: dict[str, Any]) -> list[str]:
    return [
        row["situation"],
        ", ".join(row["on"]),
        *(f"{row[name]:.0f}" for name in ("plan_us", "all_us", "none_us")),
        f"{row['ratio']:.2f}",
        f"{row['error_jnd']:.2f} ({row['error_in']})",
        f"{row['least_jnd']:.1f} ({row['least_of']})",
    ]


def _line(cells: tuple[str, ...] | list[str]) -> str:
    return f"| {' | '.join(cells)} |"
