"""The folder of an imported level: `scene.toml`, the mesh, and a mesh for each door.

`scene.toml` is a scene file whose geometry is a mesh; its other tables are those of any scene file. Heights of probes
are above the ground that is below them. Doors stand as they are at the beginning, unless `with_doors` moves them.
"""

import hashlib
import json
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, count
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, model_validator

from server.acoustics.doors import DoorLeaf, MeshWithDoors
from server.acoustics.geometry import Points
from server.acoustics.mesh import LONGEST_NAME, MeshError, TriangleMesh
from server.acoustics.sound_path import SoundPathFinder
from server.acoustics.surroundings import MeshSurroundings
from server.scene.door import Door
from server.scene.geometry import Material, Point, Strict
from server.scene.manifest import Air, Start
from server.scene.mesh_geometry import MeshGeometry
from training.data.levels.probe_places import probe_places, require_few_cells
from training.data.levels.walkable import Ground, reached_ground
from training.data.limits import FEWEST_PROBES
from training.data.scene_file import NamedEffects, Probes, SceneFile, SceneFileError, Simulation

SCENE_FILE, MESH_FILE = "scene.toml", "geometry.npz"
_SPEED_OF_SOUND = 343.0
_SWEPT = np.linspace(0, 1, 9).tolist()
"""Where doors may stand, no probe is."""
_Floats = npt.NDArray[np.float64]
_FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+\.npz$")]


class SceneDoor(Door):
    """A door of a level. The mass decides what goes through its leaf; without one, its materials' do."""

    surface_mass_kg_m2: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None


class EmitterPlace(Strict):
    name: Annotated[str, Field(min_length=1)]
    position: Point


class SpawnArea(Strict):
    """An upright box in which visitors may begin."""

    name: Annotated[str, Field(min_length=1)]
    low: Point
    high: Point


class LevelGeometry(Strict):
    """Surfaces of a level. Every material that its meshes name is in `materials`. `open_sky` says that sound may leave
    through its holes."""

    mesh: _FileName
    materials: Annotated[dict[str, Material], Field(min_length=1)]
    open_sky: bool = False
    doors: tuple[SceneDoor, ...] = ()
    emitters: tuple[EmitterPlace, ...] = ()
    spawns: tuple[SpawnArea, ...] = ()

    @model_validator(mode="after")
    def _names_once(self) -> Self:
        for table in ("doors", "emitters", "spawns"):
            names = [each.name for each in getattr(self, table)]
            if twice := [name for name in names if names.count(name) > 1]:
                raise ValueError(f"{table}: two are called {twice[0]!r}: name them apart")
        return self


class LevelFile(Strict):
    """A whole scene file of a level."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    name: str
    description: str
    geometry: LevelGeometry
    air: Air = Air()
    start: Start
    probes: Probes
    simulation: Simulation
    effects: NamedEffects = Field(default_factory=dict)
    """As in the scene file of a floor plan."""


@dataclass(frozen=True)
class LevelScene:
    """A level's folder, read. `doors` are the leaves' meshes in the order of `file.geometry.doors`. `known` are its
    surroundings, if they were found already."""

    file: LevelFile
    mesh: TriangleMesh
    doors: tuple[TriangleMesh, ...]
    known: MeshSurroundings | None = field(default=None, repr=False, compare=False)

    @property
    def id(self) -> str:
        return self.file.id

    @property
    def air(self) -> Air:
        return self.file.air

    @property
    def simulation(self) -> Simulation:
        return self.file.simulation

    @property
    def effects(self) -> dict[str, bool]:
        return self.file.effects

    @property
    def identity(self) -> dict[str, Any]:
        """What the file says, and digests of the meshes. Files without `effects` are those of earlier versions too."""
        meshes = [hashlib.sha256(mesh.to_bytes()).hexdigest() for mesh in (self.mesh, *self.doors)]
        said = self.file.model_dump(mode="json", exclude=None if self.effects else {"effects"})
        return {**said, "meshes": meshes}

    @property
    def has_mass(self) -> bool:
        """Whether any surface lets sound through."""
        return any(material.surface_mass_kg_m2 for material in self.place.materials.values())

    @cached_property
    def place(self) -> MeshGeometry:
        """All surfaces, with the leaves of doors where they stand."""
        leaves, materials = self.leaves
        at = [leaf.at(door.openness) for leaf, door in zip(leaves, self.file.geometry.doors, strict=True)]
        mesh = TriangleMesh.joined([self.mesh, *at])
        return MeshGeometry(mesh, {name: materials[name] for name in mesh.materials})

    def mesh_with_doors(self) -> MeshWithDoors:
        """The mesh in which leaves move, as a server has it. It finds ways round edges once for all states."""
        return MeshWithDoors(self.mesh, self.leaves[0], open_sky=self.file.geometry.open_sky)

    def with_doors(self, openness: Sequence[float], mesh: MeshWithDoors | None = None) -> "LevelScene":
        """The same level with its doors so far open, in their order; its surroundings are then as its
        `mesh_with_doors` finds them, if that is given."""
        geometry = self.file.geometry
        doors = [
            door.model_copy(update={"openness": share}) for door, share in zip(geometry.doors, openness, strict=True)
        ]
        moved = geometry.model_copy(update={"doors": tuple(doors)})
        known = None if mesh is None else mesh.at(tuple(openness))
        return replace(self, file=self.file.model_copy(update={"geometry": moved}), known=known)

    @cached_property
    def leaves(self) -> tuple[tuple[DoorLeaf, ...], Mapping[str, Material]]:
        """The leaves of the doors, and all materials. A door with a mass has materials of its own."""
        known = self.file.geometry.materials
        materials = {name: known[name] for name in self.mesh.materials}
        leaves = []
        for door, leaf in zip(self.file.geometry.doors, self.doors, strict=True):
            names = []
            for name in leaf.materials:
                if door.surface_mass_kg_m2 is None:
                    own, material = name, known[name]
                else:
                    own = _free_name(f"{name} of door {door.name}", known.keys() | materials.keys())
                    material = known[name].model_copy(update={"surface_mass_kg_m2": door.surface_mass_kg_m2})
                materials[own] = material
                names.append(own)
            own_mesh = TriangleMesh(leaf.vertices_m, leaf.triangles, leaf.surfaces, tuple(names))
            leaves.append(DoorLeaf(own_mesh, door.motion))
        return tuple(leaves), materials

    @cached_property
    def surroundings(self) -> MeshSurroundings:
        if self.known is not None:
            return self.known
        return MeshSurroundings(self.place.mesh, open_sky=self.file.geometry.open_sky)

    @cached_property
    def sound_paths(self) -> SoundPathFinder:
        return self.surroundings.sound_paths(_SPEED_OF_SOUND)

    @cached_property
    def ground(self) -> Ground:
        """Where a listener can walk, from the start, the spawn areas and the emitters on. No door is shut."""
        geometry, probes = self.file.geometry, self.file.probes
        areas = [np.mean([area.low, area.high], axis=0).tolist() for area in geometry.spawns]
        emitters = [self.file.start.emitter, *(emitter.position for emitter in geometry.emitters)]
        return reached_ground(
            MeshSurroundings(self.mesh, open_sky=geometry.open_sky),
            [self.file.start.listener, *areas],
            emitters,
            ear_m=probes.heights_m[0],
            head_room_m=probes.heights_m[0] + probes.wall_clearance_m,
        )

    def probe_positions(self, seed: int) -> _Floats:
        """(probe, 3) positions of ears where a listener can walk; the same for the same seed. Raises SceneFileError if
        there are too few, or too many cells for them."""
        try:
            require_few_cells(self.surroundings, self.file.probes)
        except SceneFileError as exc:
            raise SceneFileError(f"{self.id}: {exc}") from exc
        places = probe_places(self.surroundings, self.ground, self.file.probes, np.random.default_rng([seed, 0]))
        for share in _SWEPT if self.doors else ():
            surroundings = self.with_doors([share] * len(self.doors)).surroundings
            clear = surroundings.tree.distance_m(places) >= self.file.probes.wall_clearance_m
            places = places[clear & surroundings.contains(places)]
        if len(places) < FEWEST_PROBES:
            raise SceneFileError(
                f"{self.id}: probes.spacing_m: fewer than {FEWEST_PROBES} probes fit where a listener can walk, "
                f"{self.file.probes.spacing_m:g} m apart and {self.file.probes.wall_clearance_m:g} m from all surfaces "
                "(probes.wall_clearance_m)"
            )
        return places

    def path_length_m(self, a: Points, b: Points) -> _Floats:
        """(...,) lengths of the shortest paths of sound between points; straight ones where there is none."""
        ends = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
        flat = [end.reshape(-1, 3) for end in ends]
        return self.sound_paths.describe(*flat).length_m.reshape(ends[0].shape[:-1])

    @classmethod
    def read(cls, path: Path) -> "LevelScene":
        """Read a level by its scene file, beside which its meshes are, or by its folder with a `scene.toml`. Raises
        SceneFileError naming the file and the field at fault, also for materials that a mesh has and the file has not,
        and for doors with which there is more than a mesh may have."""
        path = path / SCENE_FILE if path.is_dir() else path
        folder = path.parent
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
        scene = cls(file, mesh, doors)
        try:
            _ = scene.place
        except MeshError as exc:
            raise SceneFileError(f"{path}: geometry.doors: with their leaves where they stand, {exc}") from exc
        return scene

    @classmethod
    def of_plan(cls, scene: SceneFile) -> "LevelScene":
        """A scene's floor plan as a closed mesh, with the scene's air, probes and settings. What its openings are
        called is lost, and so is what it says of effects."""
        place = MeshGeometry.of_plan(scene.geometry)
        file = LevelFile(
            id=scene.id,
            name=scene.name,
            description=scene.description,
            geometry=LevelGeometry(mesh=MESH_FILE, materials=dict(place.materials)),
            air=scene.air,
            start=scene.start,
            probes=scene.probes,
            simulation=scene.simulation,
        )
        return cls(file, place.mesh, ())

    def copy_meshes(self, source: Path, folder: Path) -> None:
        """Copy the meshes, but not the scene file, from one folder to another."""
        for name in (self.file.geometry.mesh, *(door.mesh for door in self.file.geometry.doors)):
            (folder / name).write_bytes((source / name).read_bytes())

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


def is_same_scene(one: SceneFile | LevelScene, other: SceneFile | LevelScene) -> bool:
    """Whether two scenes are the same in all that they say, and in their meshes."""
    if not (isinstance(one, LevelScene) and isinstance(other, LevelScene)):
        return one == other
    meshes = [[mesh.to_bytes() for mesh in (each.mesh, *each.doors)] for each in (one, other)]
    return one.file == other.file and meshes[0] == meshes[1]


def read_scene(path: Path) -> SceneFile | LevelScene:
    """Read a scene file, or a level by its folder or its scene file. Raises SceneFileError naming the file and the
    field at fault."""
    path = path / SCENE_FILE if path.is_dir() else path
    try:
        is_level = "mesh" in tomllib.loads(path.read_text(encoding="utf-8"))["geometry"]
    except (OSError, ValueError, RecursionError, KeyError, TypeError):
        is_level = False  # `SceneFile.read` says what is wrong
    return LevelScene.read(path) if is_level else SceneFile.read(path)


def _free_name(wanted: str, taken: Collection[str]) -> str:
    """`wanted`, no longer than a material's name may be, and with a number where that is taken."""
    short = wanted[: LONGEST_NAME - len(f" ({len(taken) + 1})")]
    numbered = (f"{short} ({number})" for number in count(2))
    return next(name for name in chain([wanted[:LONGEST_NAME]], numbered) if name not in taken)


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
