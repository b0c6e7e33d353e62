"""Commands that run in this process leave its logs as they were."""

import logging
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def logs_as_before() -> Iterator[None]:
    """`nafir serve` writes its log to the standard error of its test, which is closed when that is over."""
    root = logging.getLogger()
    before, level = [*root.handlers], root.level
    yield
    root.handlers[:] = [each for each in root.handlers if each in before or type(each) is not logging.StreamHandler]
    root.setLevel(level)
