"""What may import what: the server runs without torch and without `training`, and its packages depend one way."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SERVER = ROOT / "server"

# The packages each package may import, beside itself and the modules directly in `server`
# that depend on none of them.
MAY_IMPORT = {
    "core": set(),
    "acoustics": set(),
    "scene": {"acoustics"},
    "field": {"acoustics", "scene"},
    "rendering": {"acoustics"},
}
SHARED_MODULES = {"bounded_cache", "compiled", "core", "errors"}

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


def imported_names(source: str, package: str) -> set[str]:
    """Every absolute dotted name that the module imports, at any depth; `from a import b` gives `a.b`."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            names.update(f"{base}.{alias.name}" for alias in node.names)
    return names


def forbidden_imports(package: str, source: str, dotted_package: str) -> set[str]:
    allowed = MAY_IMPORT[package] | SHARED_MODULES | {package}
    forbidden = set()
    for name in imported_names(source, dotted_package):
        parts = name.split(".")
        if parts[0] in {"torch", "training"} or (parts[0] == "server" and (len(parts) < 2 or parts[1] not in allowed)):
            forbidden.add(name)
    return forbidden


def test_every_server_module_imports_without_torch_and_training() -> None:
    names = [module_name(path) for path in modules(SERVER)]
    assert "server.core.errors" in names
    result = subprocess.run(
        [sys.executable, "-W", "error::ImportWarning", "-c", IMPORT_ALL_WITHOUT_TRAINING, *names],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr


def test_no_server_module_names_torch_or_training() -> None:
    """Also inside functions, which importing does not reach."""
    for path in modules(SERVER):
        roots = {name.partition(".")[0] for name in imported_names(path.read_text(), "server")}
        assert not roots & {"torch", "training"}, path


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_packages_depend_one_way(package: str) -> None:
    for path in modules(SERVER / package):
        dotted_package = ".".join(path.parent.relative_to(ROOT).parts)
        assert not forbidden_imports(package, path.read_text(), dotted_package), path


@pytest.mark.parametrize(
    ("package", "line"),
    [
        ("rendering", "from server.field.field import AcousticField"),
        ("rendering", "from server import field"),
        ("rendering", "def f():\n    import server.field.field as f"),
        ("rendering", "from ..field import field"),
        ("acoustics", "import server.scene.bundle"),
        ("scene", "from server.field import loudness"),
        ("field", "from server.rendering.convolver import Convolver"),
        ("field", "import torch.nn"),
        ("field", "from training.models.factorised import FactorisedField"),
        ("field", "import server"),
    ],
)
def test_the_rule_sees_each_way_of_breaking_it(package: str, line: str) -> None:
    assert forbidden_imports(package, line, f"server.{package}")


@pytest.mark.parametrize(
    ("package", "line"),
    [
        ("field", "from server.scene.bundle import Bundle"),
        ("field", "from . import loudness"),
        ("rendering", "from server.acoustics import geometry"),
        ("scene", "from server.core.errors import BundleError"),
        ("acoustics", "import numpy as np"),
    ],
)
def test_the_rule_allows_what_the_design_allows(package: str, line: str) -> None:
    assert not forbidden_imports(package, line, f"server.{package}")


def test_what_the_image_imports_while_it_is_built_is_there() -> None:
    imports = re.findall(r"from (server[\w.]*) import (\w+)", (ROOT / "Dockerfile").read_text())
    assert imports
    for module, name in imports:
        assert hasattr(importlib.import_module(module), name), f"{module} has no {name}"
