"""Imports a level: reads it, examines and mends its mesh, and writes the scene's folder with a report."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from server.acoustics.mesh import MeshError, TriangleMesh
from server.scene.geometry import Material
from server.scene.manifest import Start
from training.data.levels.examination import Examination, examine
from training.data.levels.gltf_file import read_gltf
from training.data.levels.import_options import MERGE_WITHIN_M, PROBES, RAYS, SAMPLE_RATE_HZ, Handedness, Units, Up
from training.data.levels.level import GLTF_AXES, Axes, Level, level_of
from training.data.levels.level_scene import (
    MESH_FILE,
    SCENE_FILE,
    EmitterPlace,
    LevelFile,
    LevelGeometry,
    LevelScene,
    SceneDoor,
    SpawnArea,
)
from training.data.levels.level_source import LevelError, LevelSource
from training.data.levels.materials import Assignment, MaterialMap, table, unassigned_message
from training.data.levels.mesh_report import MeshReport
from training.data.levels.obj_file import read_obj
from training.data.levels.space import OUTSIDE
from training.data.scene_file import LONGEST_SIDE_M, SHORTEST_SIDE_M, TALLEST_M, Probes, Simulation

_Point = tuple[float, float, float]

REPORT_FILE, PICTURE_FILE = "report.json", "report.png"
_FORMATS = (".glb", ".gltf", ".obj")
_LIKELY_TALLEST_M, _LIKELY_SMALLEST_M = 60.0, 2.0
_SHORTEST_S, _LONGEST_S = 0.3, 8.0
_EYRING = 0.161
_MOST_POINTS = 500_000
"""Points of space among which the start is looked for."""
_JITTER, _NEAREST_M, _CLEAR_SHARE = 0.28, 0.5, 0.8
"""Probes are moved from the middle of their cells by at most so much of a cell's side, are at least so far apart, and
stand in about so many of the cells that have ground: in the others there is no room for one."""
_PROBES = Probes(spacing_m=1.0, jitter_m=_JITTER, wall_clearance_m=0.4, heights_m=(1.2, 1.9))
_LISTENERS = 110
"""Of each emitter: half of the usual number of places, so that more emitters take no more room and time."""
_ARRIVAL_DIRECTIONS = 48
"""With few directions, the waves that arrive from them interfere at the ears, and IACC comes out too large: that of
diffuse sound (T60 0.5 s, 48 kHz) is 0.128 with 24 directions, 0.104 with 48 and 0.099 with 240."""


@dataclass(frozen=True)
class Choices:
    """What a level's file does not say, or is to be read otherwise than it says; None where it is not given."""

    units: Units | None = None
    up: Up | None = None
    handedness: Handedness | None = None
    scene: str | None = None
    materials: Path | None = None
    default_material: str | None = None
    is_open: bool = False
    merge_within_m: float = MERGE_WITHIN_M
    sample_rate: int = SAMPLE_RATE_HZ
    rays: int = RAYS
    probes: int = PROBES
    seed: int = 0


@dataclass(frozen=True)
class ImportedLevel:
    """`scene` is None if the level was refused, and the report says why."""

    report: MeshReport
    scene: LevelScene | None
    comments: Mapping[str, str]
    places: Sequence[tuple[str, _Point]]


def read_level(path: Path, choices: Choices) -> tuple[LevelSource, Axes, list[str]]:
    """What a level's file holds, the axes in which it is read, and what was decided against its format. Raises
    LevelError for a file that is no level."""
    if path.suffix.lower() not in _FORMATS:
        raise LevelError(path, "format", f"{path.suffix or 'none'}, and levels are read from {', '.join(_FORMATS)}")
    if not path.is_file():
        raise LevelError(path, "file", "there is no such file")
    is_obj = path.suffix.lower() == ".obj"
    axes, notes = _axes(path, choices, is_obj=is_obj)
    if is_obj and choices.scene is not None:
        raise LevelError(path, "--scene", "an OBJ file has one scene: leave it out")
    return read_obj(path) if is_obj else read_gltf(path, choices.scene), axes, notes


def import_level(path: Path, choices: Choices) -> ImportedLevel:
    """Read and examine a level. Raises LevelError where nothing can be examined."""
    source, axes, notes = read_level(path, choices)
    level = level_of(path, source, axes)
    if not len(level.surfaces.triangles):
        raise LevelError(path, "triangles", "there are none that stand still: is the level on a hidden layer?")
    size, size_notes = _size(path, level)
    mapping = MaterialMap.read(choices.materials, choices.default_material)
    assignments = mapping.assign(level.material_names)
    notes += [*level.notes, *size_notes]
    notes += [f"{mapping.name}: the level has no material {name!r}" for name in mapping.unused(level.material_names)]
    try:
        seen = examine(level, is_open=choices.is_open, merge_within_m=choices.merge_within_m, seed=choices.seed)
    except MeshError as exc:
        raise LevelError(path, "mesh", str(exc)) from exc
    used = {name for mesh in (seen.mesh, *seen.doors) for name in mesh.materials}
    missing = [each for each in assignments if each.material is None and each.name in used]
    problems = [*seen.problems, *([unassigned_message(missing)] if missing else [])]
    start, start_notes = _start(level, seen)
    notes += [] if choices.is_open else _outside(level, seen)
    report = MeshReport(
        path.name,
        _words(axes),
        size,
        seen,
        [each for each in assignments if each.name in used],
        {
            "doors": [door.name for door in level.doors],
            "emitters": [name for name, _ in level.emitters],
            "spawn areas": [area.name for area in level.spawns],
        },
        [*notes, *start_notes],
        problems,
    )
    places = [("listener_start", start.listener), *level.emitters]
    if not level.emitters:
        places.append(("emitter", start.emitter))
    if problems:
        return ImportedLevel(report, None, {}, places)
    materials = {each.name: each.material for each in assignments if each.material is not None and each.name in used}
    file = _file(path, level, seen, materials, start, choices)
    scene = _with_spaced_probes(LevelScene(file, seen.mesh, seen.doors), choices.probes)
    return ImportedLevel(report, scene, _comments(report.assignments), places)


def write_level(imported: ImportedLevel, folder: Path) -> None:
    """Write the report, its picture and, if the level was not refused, the scene. A scene that was there before goes
    first, so that what is there is of one import."""
    from training.data.levels.mesh_figure import draw_mesh

    folder.mkdir(parents=True, exist_ok=True)
    for old in (folder / SCENE_FILE, folder / MESH_FILE, *folder.glob("door[0-9]*.npz")):
        old.unlink(missing_ok=True)
    report = imported.report
    (folder / REPORT_FILE).write_text(json.dumps(report.to_json(), indent=2) + "\n", encoding="utf-8")
    title = f"{report.source}: " + (f"refused: {report.problems[0]}" if report.problems else "imported")
    draw_mesh(report.examination, folder / PICTURE_FILE, title, imported.places)
    if imported.scene is not None:
        imported.scene.write(folder, imported.comments)


def _axes(path: Path, choices: Choices, *, is_obj: bool) -> tuple[Axes, list[str]]:
    """The axes of a file, as its format or else the choices say, and what was decided against the format."""
    if not is_obj:
        given = {"--units": choices.units, "--up": choices.up, "--handedness": choices.handedness}
        notes = [f"read against the specification of glTF: {name} {value}" for name, value in given.items() if value]
        axes = Axes(
            choices.up or GLTF_AXES.up, choices.handedness or GLTF_AXES.handedness, choices.units or GLTF_AXES.units
        )
        return axes, notes
    missing = [name for name, value in (("--units", choices.units), ("--up", choices.up)) if value is None]
    if choices.units is None or choices.up is None:
        raise LevelError(path, " and ".join(missing), "OBJ does not say its unit and which axis points up: give them")
    notes = (
        [] if choices.handedness else ["taken as right-handed, as OBJ files are: --handedness left if it is mirrored"]
    )
    return Axes(choices.up, choices.handedness or Handedness.RIGHT, choices.units), notes


def _words(axes: Axes) -> str:
    return f"{axes.units}, {axes.up} up, {axes.handedness}-handed"


def _size(path: Path, level: Level) -> tuple[_Point, list[str]]:
    """The size along x, y and z, and what is unlikely about it. Raises LevelError where it cannot be in metres."""
    corners = level.surfaces.corners_m.reshape(-1, 3)
    x, y, z = (float(side) for side in np.ptp(corners, axis=0))
    words = f"{x:.4g} x {y:.4g} x {z:.4g} m"
    if max(x, y) > LONGEST_SIDE_M or z > TALLEST_M:
        limits = f"at most {LONGEST_SIDE_M:g} m wide and {TALLEST_M:g} m tall"
        raise LevelError(path, "size", f"{words}, and {limits}: is its unit smaller (--units cm), or another axis up?")
    if max(x, y, z) < SHORTEST_SIDE_M:
        raise LevelError(path, "size", f"{words}, smaller than any room: is its unit larger (--units m)?")
    notes = []
    if z > _LIKELY_TALLEST_M or min(x, y) > LONGEST_SIDE_M / 2:
        notes.append(f"the level is {words}: large for a place; is its unit smaller?")
    if z < _LIKELY_SMALLEST_M or min(x, y) < _LIKELY_SMALLEST_M:
        notes.append(f"the level is {words}: small for a place; is its unit larger, or another axis up?")
    return (x, y, z), notes


def _outside(level: Level, seen: Examination) -> list[str]:
    """Notes on what stands outside of a level that has closed rooms."""
    named = [(f"emitter {name}", place) for name, place in level.emitters]
    named += [(f"spawn area {area.name}", _round(tuple((np.array(area.low) + area.high) / 2))) for area in level.spawns]
    if level.listener is not None:
        named.append(("listener_start", level.listener[0]))
    if not seen.rooms or not named:
        return []
    regions = seen.space.regions_at([place for _, place in named])
    return [
        f"{name} at ({', '.join(f'{side:.3g}' for side in place)}) is outside of all closed rooms: move it in, or say "
        "--open if the level has open sky"
        for (name, place), region in zip(named, regions, strict=True)
        if region == OUTSIDE
    ]


def _start(level: Level, seen: Examination) -> tuple[Start, list[str]]:
    """Where a visit begins: what the level names, else the places of the largest room farthest from its surfaces."""
    space, notes = seen.space, []
    volumes = np.where(seen.air, space.volumes_m3, 0.0)
    volumes[0] = volumes[0] if volumes[1:].sum() == 0 else 0.0
    free: npt.NDArray[np.float64] = np.zeros(0)
    coarse = math.ceil((space.region.size / _MOST_POINTS) ** (1 / 3))
    if level.listener is None or not level.emitters:
        region = space.region[::coarse, ::coarse, ::coarse]
        free = np.asarray(distance_transform_edt(region == int(np.argmax(volumes))))
    places: list[_Point] = []
    for _ in range(2 if len(free) else 0):
        index = np.unravel_index(int(np.argmax(free)), free.shape)
        at = space.origin_m + coarse * space.step_m * np.array(index)
        places.append((round(float(at[0]), 3), round(float(at[1]), 3), round(float(at[2]), 3)))
        # The second place is far from the surfaces and from the first.
        grids = np.ogrid[tuple(slice(0, side) for side in free.shape)]
        apart = np.sqrt(sum((grid - own) ** 2 for grid, own in zip(grids, index, strict=True)))
        free = np.minimum(free, apart / 2)
    listener, yaw = level.listener or (places[0], 0.0)
    if level.listener is None:
        notes.append(f"there is no listener_start: visits begin at {_round(listener)}")
    if level.spawns and level.listener is None:
        area = level.spawns[0]
        listener = _round(tuple((np.array(area.low) + area.high) / 2))
        notes[-1] = f"there is no listener_start: visits begin in the middle of the spawn area {area.name!r}"
    emitter = level.emitters[0][1] if level.emitters else places[1]
    if not level.emitters:
        notes.append(f"there is no emitter_NAME: the first emitter stands at {_round(emitter)}")
    return Start(listener=_round(listener), listener_yaw_deg=round(yaw, 2), emitter=_round(emitter)), notes


def _file(
    path: Path,
    level: Level,
    seen: Examination,
    materials: Mapping[str, Material],
    start: Start,
    choices: Choices,
) -> LevelFile:
    doors = tuple(
        SceneDoor(
            name=door.name,
            mesh=f"door{index}.npz",
            kind=door.kind,
            pivot=_round(door.pivot),
            angle_deg=door.angle_deg,
            slide_m=_round(door.slide_m),
            openness=door.openness,
            surface_mass_kg_m2=door.mass_kg_m2,
        )
        for index, door in enumerate(level.doors)
    )
    name = re.sub(r"[^a-z0-9_-]+", "-", path.stem.lower()).strip("-_")
    rooms = f"{len(seen.rooms)} closed room{'' if len(seen.rooms) == 1 else 's'}"
    return LevelFile(
        id=name or "level",
        name=path.stem,
        description=f"Imported from {path.name}: {len(seen.mesh.triangles):,} triangles, {rooms} with all doors shut.",
        geometry=LevelGeometry(
            mesh=MESH_FILE,
            materials=dict(materials),
            open_sky=choices.is_open,
            doors=doors,
            emitters=tuple(EmitterPlace(name=name, position=_round(at)) for name, at in level.emitters),
            spawns=tuple(
                SpawnArea(name=area.name, low=_round(area.low), high=_round(area.high)) for area in level.spawns
            ),
        ),
        start=start,
        probes=_PROBES,
        simulation=Simulation(
            sample_rate=choices.sample_rate,
            duration_s=_duration_s(seen, materials),
            yaws=12,
            rays=choices.rays,
            image_order=3,
            arrival_directions=_ARRIVAL_DIRECTIONS,
            listeners=_LISTENERS,
            held_out_share=0.1,
        ),
    )


def _with_spaced_probes(scene: LevelScene, wanted: int) -> LevelScene:
    """The level with probes so far apart that about so many stand on the ground that is reached; no nearer than
    _NEAREST_M."""
    ground = scene.ground
    area_m2 = len(ground.spots) * ground.step_m**2
    spacing_m = max(_NEAREST_M, round(math.sqrt(_CLEAR_SHARE * area_m2 / wanted), 2))
    probes = scene.file.probes.model_copy(update={"spacing_m": spacing_m, "jitter_m": round(_JITTER * spacing_m, 3)})
    return replace(scene, file=scene.file.model_copy(update={"probes": probes}))


def _duration_s(seen: Examination, materials: Mapping[str, Material]) -> float:
    """The longest reverberation time of any octave band by Eyring's formula, over all air and surfaces together, within
    what is usual."""
    volume = sum(room.volume_m3 for room in seen.rooms) or float(np.prod(np.ptp(seen.mesh.bounds_m, axis=0)))
    mesh: TriangleMesh = seen.mesh
    areas = np.array([mesh.areas_m2[mesh.surfaces == index].sum() for index in range(len(mesh.materials))])
    absorption = np.array([materials[name].absorption for name in mesh.materials])
    mean = np.clip(areas @ absorption / areas.sum(), 1e-3, 0.99)
    longest = float(np.max(_EYRING * volume / (-areas.sum() * np.log1p(-mean))))
    return math.ceil(10 * min(max(longest, _SHORTEST_S), _LONGEST_S)) / 10


def _comments(assignments: Sequence[Assignment]) -> dict[str, str]:
    """Where the values of each material are from, before its table in the scene file."""
    comments = {}
    for each in assignments:
        kind, _, row = each.how.partition(": ")
        source = table()[row].source if row in table() else ""
        key = each.name if re.fullmatch(r"[A-Za-z0-9_-]+", each.name) else json.dumps(each.name, ensure_ascii=False)
        comments[f"geometry.materials.{key}"] = f"From {kind}: {row}" + (f" ({source})" if source else "")
    comments["probes"] = "Heights are above the ground on which a listener walks."
    comments["simulation"] = "The duration is the longest reverberation time by Eyring's formula."
    return comments


def _round(point: Sequence[float]) -> _Point:
    x, y, z = (round(float(value), 4) + 0.0 for value in point)
    return x, y, z
