"""What every hard case shares: a way to state a law as a bound, and a table of how near it came.

A case calls `measured(what, value, bound, unit)`; the value has to stay within the bound. With
`--hard-cases-table FILE` the suite writes what was measured to a Markdown file (`make hard-cases`).
"""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.hard_cases.results import Measurement, Measurements, markdown

# The same examples in every run, as many as there is time for; `measured` keeps the worst of them.
settings.register_profile(
    "hard_cases",
    deadline=None,
    derandomize=True,
    max_examples=40,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
_PROPERTY = "measured"
_OPTION = "--hard-cases-table"


def pytest_addoption(parser):
    parser.addoption(_OPTION, type=Path, help="write bounds and measured margins of the hard cases to this file")


def pytest_configure(config):
    if config.getoption(_OPTION, default=None) and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Table(config.getoption(_OPTION)))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """`given` takes the profile that is in effect where it stands: as its module is imported."""
    if not isinstance(collector, pytest.Module):
        return (yield)
    before = settings.get_current_profile_name()
    settings.load_profile("hard_cases")
    try:
        return (yield)
    finally:
        settings.load_profile(before)


@pytest.fixture
def measured(record_property):
    """`measured(what, value, bound, unit="", *, at_least=False)`: asserts that `value` is at most `bound`, or, with
    `at_least`, at least; a value that is not a number is neither. What is measured several times in a case is kept at
    its worst."""
    measurements = Measurements()
    yield measurements
    for found in measurements.worst.values():
        record_property(_PROPERTY, found.as_json())


class _Table:
    """Gathers measurements, from other processes too, and writes them at the end."""

    def __init__(self, path):
        self._path = path
        self._found = {}

    def pytest_runtest_logreport(self, report):
        texts = [value for name, value in report.user_properties if name == _PROPERTY]
        if report.when == "teardown" and texts:
            self._found[report.nodeid] = [Measurement.from_json(text) for text in texts]

    def pytest_sessionfinish(self):
        self._path.write_text(markdown(self._found))
