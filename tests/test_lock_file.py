"""`requirements.lock` has what the image installs, exact, with digests, and no name of a host."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "requirements.lock").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
BASE = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["jwt"]]
ENTRY = re.compile(
    r"^([a-z0-9-]+)==(\S+)(?: ; [^\\\n]+)? \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", re.MULTILINE
)
LOCKED = {canonicalize_name(name): version for name, version, _ in ENTRY.findall(TEXT)}


@pytest.mark.parametrize("line", BASE)
def test_every_base_dependency_is_locked_within_its_bounds(line: str) -> None:
    requirement = Requirement(line)
    version = LOCKED.get(canonicalize_name(requirement.name))
    assert version is not None, f"{requirement.name} is not in requirements.lock: run `make lock`"
    assert requirement.specifier.contains(version), f"{version} is not {line}: run `make lock`"


def test_every_line_is_a_pin_with_digests_or_says_why() -> None:
    rest = [line for line in ENTRY.sub("", TEXT).splitlines() if not line.lstrip().startswith("#")]
    assert rest == []
    assert len(LOCKED) > len(BASE)


def test_what_base_dependencies_need_is_locked_too() -> None:
    """As the versions installed here say it: with `--require-hashes` pip refuses what is not in the file."""
    for name in LOCKED:
        try:
            needed = [Requirement(line) for line in requires(name) or ()]
        except PackageNotFoundError:
            continue
        for requirement in needed:
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                assert canonicalize_name(requirement.name) in LOCKED, (
                    f"{name} needs {requirement.name}: run `make lock`"
                )


def test_nothing_of_the_training_side_is_in_the_image() -> None:
    assert not {"torch", "matplotlib", "onnx", "pytest"} & LOCKED.keys()


def test_no_host_is_named() -> None:
    assert not re.search(r"https?:|--(?:extra-)?index-url|--find-links|--trusted-host|file:", TEXT)


def test_the_image_installs_from_the_lock_file_alone() -> None:
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    lines = re.findall(r"pip (?:--python \S+ )?(?:install|wheel) [^&]*", text)
    downloads = [line for line in lines if "--require-hashes" in line]
    others = [line for line in lines if line not in downloads]
    assert len(downloads) > 1
    assert all(re.search(r"--requirement \S+\.lock\b", line) for line in downloads)
    made = re.findall(r"(\S+) > \S+\.lock\b", text)
    assert made == ["requirements.lock"] * len(made)
    assert len(others) == 2
    for line in others:  # of what is there already: the server itself, and what was built from downloads
        assert "--no-deps" in line
        assert {".", "/wheels/*.whl"} & set(line.split())
    assert "!requirements.lock" in (ROOT / ".dockerignore").read_text().splitlines()
