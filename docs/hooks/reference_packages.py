"""The packages and their imports, read from the code and drawn in the order of the `import-linter` contracts."""

import ast
import tomllib
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Final

from reference_text import code, table

_ROOT: Final = Path(__file__).parents[2]
_CELL, _LEFT, _TOP = 22, 110, 100


def packages() -> str:
    """Return a list of every package of both sides, from the ground up, with its modules."""
    parts = []
    for root in ("server", "training"):
        rows = [(code(f"{root}/{name}/"), _modules(root, name)) for name in reversed(_order(root))]
        parts.append(f"**`{root}/`**\n\n{table(['package', 'modules'], rows)}")
    return "\n".join(parts)


def _modules(root: str, package: str) -> str:
    folder = _ROOT / root / package
    modules = sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")
    nested = sorted(f"{path.parent.name}/" for path in folder.glob("*/__init__.py"))
    return ", ".join([*modules, *nested])


def package_matrix() -> str:
    """Return one SVG for the server and one for the training side: a row imports the columns with a filled square."""
    return "\n\n".join(f"**`{root}/`**\n\n{_drawn(root)}" for root in ("server", "training"))


def _drawn(root: str) -> str:
    names, imports = list(reversed(_order(root))), _imports(root)
    width, height = _LEFT + _CELL * len(names) + 10, _TOP + _CELL * len(names) + 10
    shapes = []
    for row, importer in enumerate(names):
        y = _TOP + row * _CELL
        shapes.append(f'<text x="{_LEFT - 8}" y="{y + 15}" text-anchor="end">{importer}</text>')
        x = _LEFT + row * _CELL
        shapes.append(f'<text transform="translate({x + 15},{_TOP - 8}) rotate(-60)">{importer}</text>')
        for column, imported in enumerate(names):
            fill = "currentColor" if (importer, imported) in imports else "none"
            opacity = 0.15 if row == column else 1
            fill = "currentColor" if row == column else fill
            place = f'x="{_LEFT + column * _CELL}" y="{y}" width="{_CELL - 3}" height="{_CELL - 3}"'
            title = f"<title>{importer} imports {imported}</title>" if fill != "none" and row != column else ""
            shapes.append(
                f'<rect {place} fill="{fill}" fill-opacity="{opacity}" stroke="currentColor" stroke-opacity="0.25">'
                f"{title}</rect>"
            )
    body = "".join(shapes)
    return (
        f'<svg class="matrix" role="img" aria-label="Packages of {root} and what each imports" '
        f'viewBox="0 0 {width} {height}" style="max-width:{width}px" font-size="12" fill="currentColor">{body}</svg>'
    )


@cache
def _order(root: str) -> Sequence[str]:
    """Return the packages from the top down, as in the contract in pyproject.toml."""
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    (layers,) = (each["layers"] for each in contracts if each.get("containers") == [root])
    return [name.strip() for layer in layers for name in layer.split(":")]


@cache
def _imports(root: str) -> frozenset[tuple[str, str]]:
    """Return pairs of packages: the first imports the second."""
    return frozenset(
        (path.relative_to(_ROOT / root).parts[0], parts[1])
        for path in (_ROOT / root).glob("*/**/*.py")
        for module in _imported(path)
        if len(parts := module.split(".")) > 1 and parts[0] == root and (_ROOT / root / parts[1]).is_dir()
        if path.relative_to(_ROOT / root).parts[0] != parts[1]
    )


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
