"""The folder of an imported level: `scene.toml`, the mesh, and a mesh for each door.

`scene.toml` is a scene file whose geometry is a mesh; its other tables are those of any scene file. Heights of probes
are above the floor that is below them.
"""

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from server.acoustics.mesh import MeshError, TriangleMesh
from server.scene.geometry import Finite, Material, Point, Strict
from server.scene.manifest import Air, Start
from training.data.scene_file import Probes, SceneFileError, Simulation

SCENE_FILE, MESH_FILE = "scene.toml", "geometry.npz"
_FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+\.npz$")]


class Door(Strict):
    """A leaf, as it is when shut, in the file `mesh`. A swing turns by `angle_deg` about the upright line through
    `pivot`, counter-clockwise as seen from above, when it opens; a slide moves by `slide_m`. `openness` is that at the
    beginning, 0 shut and 1 open. The mass decides what goes through; without one, its materials' do."""

    name: Annotated[str, Field(min_length=1)]
    mesh: _FileName
    kind: Literal["swing", "slide"]
    pivot: Point
    angle_deg: Finite
    slide_m: Point
    openness: Annotated[float, Field(ge=0, le=1)]
    surface_mass_kg_m2: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None


class EmitterPlace(Strict):
    name: Annotated[str, Field(min_length=1)]
    position: Point


class SpawnArea(Strict):
    """An upright box in which visitors may begin."""

    name: Annotated[str, Field(min_length=1)]
    low: Point
    high: Point


class MeshGeometry(Strict):
    """Surfaces of a level. Every material that its meshes name is in `materials`. `open_sky` says that sound may leave
    through its holes."""

    mesh: _FileName
    materials: Annotated[dict[str, Material], Field(min_length=1)]
    open_sky: bool = False
    doors: tuple[Door, ...] = ()
    emitters: tuple[EmitterPlace, ...] = ()
    spawns: tuple[SpawnArea, ...] = ()

    @model_validator(mode="after")
    def _names_once(self) -> Self:
        for field in ("doors", "emitters", "spawns"):
            names = [each.name for each in getattr(self, field)]
            if twice := [name for name in names if names.count(name) > 1]:
                raise ValueError(f"{field}: two are called {twice[0]!r}: name them apart")
        return self


class LevelFile(Strict):
    """A whole scene file of a level."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    name: str
    description: str
    geometry: MeshGeometry
    air: Air = Air()
    start: Start
    probes: Probes
    simulation: Simulation


@dataclass(frozen=True)
class LevelScene:
    """A level's folder, read. `doors` are the leaves' meshes in the order of `file.geometry.doors`."""

    file: LevelFile
    mesh: TriangleMesh
    doors: tuple[TriangleMesh, ...]

    @classmethod
    def read(cls, folder: Path) -> "LevelScene":
        """Raises SceneFileError naming the file and the field at fault, also for materials that a mesh has and the
        file has not."""
        path = folder / SCENE_FILE
        try:
            file = LevelFile.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
            mesh = TriangleMesh.load(folder / file.geometry.mesh)
            doors = tuple(TriangleMesh.load(folder / door.mesh) for door in file.geometry.doors)
        except OSError as exc:
            raise SceneFileError(f"{exc.filename}: cannot be read: {exc.strerror}") from exc
        except MeshError as exc:
            raise SceneFileError(str(exc)) from exc
        except ValidationError as exc:
            first = exc.errors()[0]
            place = ".".join(map(str, first["loc"]))
            raise SceneFileError(f"{path}: {place}: {first['msg'].removeprefix('Value error, ')}") from exc
        except (ValueError, RecursionError) as exc:
            raise SceneFileError(f"{path}: not TOML: {exc}") from exc
        for name in {name for each in (mesh, *doors) for name in each.materials}:
            if name not in file.geometry.materials:
                raise SceneFileError(f"{path}: geometry.materials: {name!r} is missing, and a mesh has it")
        return cls(file, mesh, doors)

    def write(self, folder: Path, comments: Mapping[str, str] | None = None) -> None:
        """Write the folder's files. `comments` go before the tables of these names, such as `geometry.materials.brick`.

        The same scene gives the same bytes.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self.mesh.save(folder / self.file.geometry.mesh)
        for door, leaf in zip(self.file.geometry.doors, self.doors, strict=True):
            leaf.save(folder / door.mesh)
        lines = _table("", self.file.model_dump(mode="json", exclude_none=True), comments or {})
        (folder / SCENE_FILE).write_text("\n".join(lines).lstrip("\n") + "\n", encoding="utf-8")


def _table(name: str, content: Mapping[str, Any], comments: Mapping[str, str]) -> list[str]:
    """Lines of a TOML table: its values first, then the tables and lists of tables in it."""
    lines = []
    plain = {key: value for key, value in content.items() if not _is_table(value)}
    if name and (plain or name in comments):
        lines += ["", *(f"# {line}" for line in comments.get(name, "").splitlines()), f"[{name}]"]
    lines += [f"{_key(key)} = {_value(value)}" for key, value in plain.items() if value != []]
    for key, value in content.items():
        below = f"{name}.{_key(key)}".lstrip(".")
        if isinstance(value, Mapping):
            lines += _table(below, value, comments)
        elif _is_table(value):
            for each in value:
                lines += ["", f"[[{below}]]", *_table("", each, comments)]
    return lines


def _is_table(value: object) -> bool:
    return isinstance(value, Mapping) or (isinstance(value, Sequence) and bool(value) and isinstance(value[0], Mapping))


def _key(key: str) -> str:
    return key if key.isascii() and key.replace("_", "").replace("-", "").isalnum() else _value(key)


def _value(value: object) -> str:
    """A value of TOML, whose basic strings escape as JSON's do, but for the delete character."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
