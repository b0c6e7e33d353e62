"""Acoustics of a level's materials: a table of published values, names matched to it, and a file that maps the rest.

A material of a level is found in the table if all words of one of a row's names are among its own words, whatever their
case and order: `Mat_BrickWall_01` has the word brick. If several rows fit, that with the most words is taken; if these
are equal too, none is.
"""

import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError, model_validator

from server.scene.geometry import Material, PerBand, Strict
from training.data.levels.level_source import LevelError

TABLE = Path(__file__).parent / "acoustic_materials.toml"
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-zäöüß]+|\d+", re.UNICODE)
_SUGGESTIONS = 3
_NEAR = 0.6


class TableRow(Strict):
    """A row of the table. `source` says where its absorption is published, `scattering_source` where its scattering is,
    which is an estimate if it is empty."""

    names: Annotated[tuple[str, ...], Field(min_length=1)]
    absorption: PerBand
    scattering: PerBand
    surface_mass_kg_m2: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None
    source: Annotated[str, Field(min_length=1)]
    scattering_source: str = ""

    @property
    def material(self) -> Material:
        return Material(
            absorption=self.absorption, scattering=self.scattering, surface_mass_kg_m2=self.surface_mass_kg_m2
        )


class _Mapped(Strict):
    """A material in a mapping file: a row of the table (`like`) with changes, or absorption and scattering of its
    own."""

    like: str | None = None
    absorption: PerBand | None = None
    scattering: PerBand | None = None
    surface_mass_kg_m2: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> "_Mapped":
        if self.like is None and (self.absorption is None or self.scattering is None):
            raise ValueError("give absorption and scattering, or the row of the table that it is like")
        return self


class _MappingFile(Strict):
    default: str | None = None
    materials: dict[str, str | _Mapped] = Field(default_factory=dict)


@dataclass(frozen=True)
class Assignment:
    """What one material of a level is. `how` says why: `table: brick`, `map.toml: like glass`, `default: plaster`. If
    `material` is None nobody knows it, and `suggestions` are rows with near names."""

    name: str
    material: Material | None
    how: str
    suggestions: tuple[str, ...] = ()


@cache
def table() -> Mapping[str, TableRow]:
    """The rows of the table that ships, by name."""
    rows = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    return {name: TableRow.model_validate(row) for name, row in rows.items()}


@dataclass(frozen=True)
class MaterialMap:
    """A mapping file, and the row for materials that neither it nor the table knows."""

    name: str = ""
    mapped: Mapping[str, str | _Mapped] | None = None
    default: str | None = None

    @classmethod
    def read(cls, path: Path | None, default: str | None) -> "MaterialMap":
        """`default` goes before the file's own. Raises LevelError naming the file and the field at fault."""
        content = _MappingFile() if path is None else _read(path)
        chosen = default or content.default
        where = "--default-material" if default else f"{path}: default"
        if chosen is not None and chosen not in table():
            raise LevelError(where, chosen, f"is no row of the table{_or_near(chosen)}")
        for name, given in content.materials.items():
            like = given if isinstance(given, str) else given.like
            if like is not None and like not in table():
                raise LevelError(path, f"materials.{name}", f"{like!r} is no row of the table{_or_near(like)}")
        return cls("" if path is None else path.name, content.materials, chosen)

    def assign(self, names: Iterable[str]) -> list[Assignment]:
        """One assignment for each name, in their order."""
        return [self._assignment(name) for name in names]

    def unused(self, names: Iterable[str]) -> list[str]:
        """Names that the file maps and the level does not have."""
        return sorted(set(self.mapped or ()) - set(names))

    def _assignment(self, name: str) -> Assignment:
        given = (self.mapped or {}).get(name)
        if isinstance(given, str):
            return Assignment(name, table()[given].material, f"{self.name}: {given}")
        if given is not None:
            return Assignment(name, _own(given), f"{self.name}: {f'like {given.like}' if given.like else 'its own'}")
        row = find(name)
        if row is not None:
            return Assignment(name, table()[row].material, f"table: {row}")
        if self.default is not None:
            return Assignment(name, table()[self.default].material, f"default: {self.default}")
        return Assignment(name, None, "unassigned", suggestions(name))


def words_of(name: str) -> tuple[str, ...]:
    """Words of a name in lower case: `Mat_BrickWall.001` has mat, brick, wall and 001."""
    return tuple(word.lower() for word in _WORD.findall(name))


def find(name: str) -> str | None:
    """The row of the table that a material's name means, or None if none or several fit equally well."""
    if name in table():
        return name
    words = set(words_of(name))
    fits: dict[str, int] = {}
    for row, described in table().items():
        lengths = [len(parts) for parts in map(words_of, (row, *described.names)) if set(parts) <= words]
        if lengths:
            fits[row] = max(lengths)
    best = [row for row, length in fits.items() if length == max(fits.values())]
    return best[0] if len(best) == 1 else None


def suggestions(name: str) -> tuple[str, ...]:
    """Rows of the table with names near to this one's words, or that it names among others, the nearest first."""
    words = words_of(name)
    scores: dict[str, float] = {}
    for row, described in table().items():
        known = {word for each in (row, *described.names) for word in words_of(each)}
        ratios = [difflib.SequenceMatcher(None, word, other).ratio() for word in words for other in known]
        if ratios and max(ratios) >= _NEAR:
            scores[row] = max(ratios)
    return tuple(sorted(scores, key=lambda row: (-scores[row], row))[:_SUGGESTIONS])


def unassigned_message(missing: Sequence[Assignment]) -> str:
    """What is wrong with materials that nobody knows, and what to do."""
    lines = [
        f"{each.name or '(no name)'!r}" + (f" (near: {', '.join(each.suggestions)})" if each.suggestions else "")
        for each in missing
    ]
    return (
        f"nobody knows {'; '.join(lines)}: map them in a file for --materials, or name a row of the table for all of "
        "them by --default-material"
    )


def _own(given: _Mapped) -> Material:
    base: dict[str, Any] = {} if given.like is None else table()[given.like].material.model_dump()
    changes = given.model_dump(exclude={"like"}, exclude_none=True)
    return Material.model_validate({**base, **changes})


def _or_near(name: str) -> str:
    near = suggestions(name)
    return f"; near: {', '.join(near)}" if near else f"; there are {', '.join(table())}"


def _read(path: Path) -> _MappingFile:
    try:
        return _MappingFile.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as exc:
        raise LevelError(path, "file", f"cannot be read: {exc.strerror}") from exc
    except ValidationError as exc:
        # A union's errors name its branches; the last of them is that of a whole material.
        last = exc.errors()[-1]
        place = ".".join(str(part) for part in last["loc"] if part != "str" and _Mapped.__name__ not in str(part))
        raise LevelError(path, place, last["msg"].removeprefix("Value error, ")) from exc
    except (ValueError, RecursionError) as exc:
        raise LevelError(path, "file", f"is no TOML: {exc}") from exc
