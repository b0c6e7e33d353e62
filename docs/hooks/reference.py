"""MkDocs hook: generates the reference pages from the code, so that they always agree with it.

A page has `<!-- generated: NAME -->` where the text of `GENERATORS[NAME]` goes.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any, Final

from reference_commands import commands_of
from reference_errors import error_definitions
from reference_goals import bench_goals
from reference_limits import limits
from reference_load import admission_limits, load_thresholds
from reference_packages import package_matrix, packages
from reference_schemas import manifest, settings
from reference_services import http, metrics, problem_codes, stream, stream_codes

GENERATORS: Final[Mapping[str, Callable[[], str]]] = {
    "nafir": lambda: commands_of("server.cli.main", "nafir"),
    "nafir-train": lambda: commands_of("training.cli.main", "nafir-train"),
    "settings": settings,
    "limits": limits,
    "http": http,
    "stream": stream,
    "manifest": manifest,
    "problem-codes": problem_codes,
    "stream-codes": stream_codes,
    "metrics": metrics,
    "packages": packages,
    "package-matrix": package_matrix,
    "load-thresholds": load_thresholds,
    "admission-limits": admission_limits,
    "error-definitions": error_definitions,
    "bench-goals": bench_goals,
}
_MARK: Final = re.compile(r"^<!-- generated: ([a-z-]+) -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the marks of a page by generated text. Raises KeyError for a mark that names no generator."""
    return _MARK.sub(lambda mark: GENERATORS[mark[1]](), markdown)
