"""The server runs without torch and without `training`. `lint-imports` checks which package imports which, by the
contracts in pyproject.toml."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SERVER = ROOT / "server"

IMPORT_ALL_WITHOUT_TRAINING = """
import importlib, sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"torch", "training"}:
            raise ImportError(f"{name} is not part of the server")
        return None

sys.meta_path.insert(0, Blocked())
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.py"))


WITH_RAY = ("server.cluster.deployment", "server.cluster.routing")
"""The one says that it needs Ray, the other runs in Ray alone."""


def test_every_server_module_imports_without_torch_and_training() -> None:
    names = [module_name(path) for path in modules(SERVER)]
    if importlib.util.find_spec("ray") is None:
        for name in WITH_RAY:
            names.remove(name)
    assert "server.core.errors" in names
    result = subprocess.run(
        [sys.executable, "-W", "error::ImportWarning", "-c", IMPORT_ALL_WITHOUT_TRAINING, *names],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr


def test_what_the_image_imports_while_it_is_built_is_there() -> None:
    imports = re.findall(r"from (server[\w.]*) import (\w+)", (ROOT / "Dockerfile").read_text())
    assert imports
    for module, name in imports:
        assert hasattr(importlib.import_module(module), name), f"{module} has no {name}"


SLOW = (
    "asyncio",
    "fastapi",
    "matplotlib",
    "numba",
    "numba.np.arraymath",  # what numba compiles arrays by
    "onnxruntime",
    "PIL",
    "requests",
    "numba.np.arrayobj",
    "rich.console",
    "scipy",
    "scipy.fft",
    "scipy.io",
    "scipy.linalg",
    "scipy.ndimage",
    "scipy.signal",
    "scipy.sparse",
    "scipy.spatial",
    "scipy.stats",
    "sofar",
    "uvicorn",
)
RUN_AND_TELL = """
import sys
from server.cli.main import main
slow, sys.argv = sys.argv[1].split(","), ["nafir", *sys.argv[2:]]
try:
    main()
except SystemExit as exc:
    assert not exc.code, exc.code
sys.stderr.write(",".join(name for name in slow if name in sys.modules))
"""
IR = "ir apartment --listener 1.5,2,1.5 --emitter 3,2,1.5 --output"


@pytest.mark.parametrize(
    ("command", "needed"),
    [("--help", {"rich.console"}), ("serve --help", {"rich.console"}), (IR, {"numba", "onnxruntime"})],
    ids=["help", "help of a command", "ir"],
)
def test_a_command_imports_nothing_slow_that_it_does_not_need(command, needed, tmp_path):
    """Each of these takes a tenth of a second to a whole one."""
    arguments = command.split() + ([str(tmp_path / "response.wav")] if command == IR else [])
    run = [sys.executable, "-c", RUN_AND_TELL, ",".join(SLOW), *arguments]
    if command == IR:  # whatever is compiled is compiled by the first
        subprocess.run(run, cwd=ROOT, capture_output=True, check=True)
    result = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True)
    assert set(filter(None, result.stderr.split(","))) == needed


LOAD_AND_TELL = """
import sys
from server.api.app import create_app
from server.api.catalogue import load_hrtfs, load_scenes
from server.planning.places import place_of_field
scenes = load_scenes([])
load_hrtfs([], scenes)
for levels in scenes.values():
    place_of_field(levels.default)
print(*(name for name in ("matplotlib", "requests", "scipy.spatial", "sofar", "torch") if name in sys.modules))
"""


def test_a_server_of_the_bundled_scenes_reads_no_measured_head():
    """KEMAR is prepared at the sample rate of each bundled scene. Reading and filtering it takes two seconds."""
    run = [sys.executable, "-c", LOAD_AND_TELL]
    assert subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split() == []
