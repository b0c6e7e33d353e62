"""The documentation, built once as `make docs` builds it."""

import html
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.once_a_run import once

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fails with what mkdocs says where a link leads nowhere or a page is in no menu."""
    return once("site", build, tmp_path_factory)


def build(folder: Path) -> None:
    # Without --quiet, with which --strict counts no warnings.
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert built.returncode == 0, built.stdout + built.stderr


@pytest.fixture(scope="session")
def page(site: Path) -> Callable[[str], str]:
    """The text of the body of a page, without its tags and the menus about it."""

    def read(name: str) -> str:
        (body,) = re.findall(r"<article.*?</article>", (site / name / "index.html").read_text(), re.DOTALL)
        return html.unescape(re.sub(r"<[^>]*>", "", body))

    return read
