"""The manifest of a bundle: for a simulated scene with everything in the scene file, for a measured scene with what is
known of it."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from server.acoustics.decibels import power_to_db
from server.scene.door import Door
from server.scene.effects import EffectName
from server.scene.geometry import Point
from server.scene.manifest import (
    DIRECTIONS_FORMAT,
    EARS_FORMAT,
    MESH_FORMAT,
    Bounds,
    CodecParameters,
    FieldFile,
    Manifest,
    QualityLevel,
    SceneMesh,
    Start,
)
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.levels.level_scene import MESH_FILE, LevelScene
from training.data.responses import ImportedDataset, ResponsesError
from training.data.scene_file import SceneFile
from training.simulation.responses import SimulatedResponses

_MARGIN_M = 0.1
_LEVELLED_ROWS = 500
_DIRECT_S = (-0.001, 0.0025)  # around the arrival that follows from distance


@dataclass(frozen=True)
class Fields:
    """What a manifest says about the bundle's files."""

    codec: CodecParameters
    fields: dict[str, FieldFile]
    levels: tuple[QualityLevel, ...]
    files: dict[str, str]


def simulated_manifest(responses: SimulatedResponses, fields: Fields, *, whole: bool = False) -> Manifest:
    """The manifest of a simulated scene. `whole`: the fields include direct sound and first reflections."""
    scene = responses.dataset.place
    if isinstance(scene, LevelScene):
        return _level_manifest(scene, responses, fields, whole=whole)
    has_directions = any(field.predicts == "directions" for field in fields.fields.values())
    low, high = np.min(scene.geometry.corners, axis=0), np.max(scene.geometry.corners, axis=0)
    return Manifest(
        id=scene.id,
        name=scene.name,
        description=scene.description,
        geometry=scene.geometry,
        bounds=Bounds(
            minimum=(float(low[0]), float(low[1]), scene.probes.heights_m[0]),
            maximum=(float(high[0]), float(high[1]), scene.probes.heights_m[1]),
        ),
        speed_of_sound=SPEED_OF_SOUND,
        air=scene.air,
        image_order=0 if whole else GEOMETRIC_ORDER,
        direct_sound="field" if whole else "geometry",
        transmission=responses.dataset.effects.transmission,
        start=scene.start,
        effects=rendered_effects(scene),
        format_version=DIRECTIONS_FORMAT if has_directions else EARS_FORMAT,
        codec=fields.codec,
        fields=fields.fields,
        levels=fields.levels,
        files=fields.files,
    )


def rendered_effects(scene: SceneFile | LevelScene) -> dict[EffectName, bool]:
    """The effects of a scene file that rendering has, on or off."""
    return {name: scene.effects[name] for name in EffectName if name in scene.effects}


def mesh_files(level: LevelScene, *, moving: bool) -> tuple[SceneMesh, dict[str, bytes]]:
    """What a manifest says about the mesh of a level, and its files. Doors are leaves that move, or else part of the
    mesh, where they stand at the beginning."""
    doors, files = [], {MESH_FILE: (level.mesh if moving else level.place.mesh).to_bytes()}
    if moving:
        leaves, _ = level.leaves
        doors = [Door(**door.model_dump(exclude={"surface_mass_kg_m2"})) for door in level.file.geometry.doors]
        files |= {door.mesh: leaf.mesh.to_bytes() for door, leaf in zip(doors, leaves, strict=True)}
    materials = dict(level.place.materials)
    mesh = SceneMesh(file=MESH_FILE, materials=materials, open_sky=level.file.geometry.open_sky, doors=tuple(doors))
    return mesh, files


def _level_manifest(level: LevelScene, responses: SimulatedResponses, fields: Fields, *, whole: bool) -> Manifest:
    mesh, files = mesh_files(level, moving=len(responses.dataset.doors) > 0)
    (west, south, low), (east, north, high) = level.place.mesh.bounds_m.tolist()
    return Manifest(
        id=level.id,
        name=level.file.name,
        description=level.file.description,
        mesh=mesh,
        bounds=Bounds(minimum=(west, south, low), maximum=(east, north, high)),
        speed_of_sound=SPEED_OF_SOUND,
        air=level.air,
        image_order=0 if whole else GEOMETRIC_ORDER,
        direct_sound="field" if whole else "geometry",
        transmission=responses.dataset.effects.transmission,
        start=level.file.start,
        effects=rendered_effects(level),
        format_version=MESH_FORMAT,
        codec=fields.codec,
        fields=fields.fields,
        levels=fields.levels,
        files={**fields.files, **dict.fromkeys(files, "0" * 64)},
    )


def measured_manifest(responses: ImportedDataset, fields: Fields) -> Manifest:
    """The manifest of a measured scene, named after the source. Its bounds are a box around all positions, with a small
    margin; inside the box but far from all measurements, responses are guesses. The start is a pair at the median
    distance, with the listener facing the emitter."""
    positions = np.concatenate([responses.listener, responses.emitter])
    name = Path(responses.source).stem
    offset = responses.emitter - responses.listener
    distance = np.linalg.norm(offset, axis=-1)
    usual = int(np.argmin(np.abs(distance - np.median(distance))))
    counts = (len(np.unique(each, axis=0)) for each in (responses.listener, responses.emitter))
    listeners, emitters = counts
    return Manifest(
        id=re.sub("[^a-z0-9_-]+", "-", name.lower()).strip("-_") or "measured",
        name=name.replace("_", " ").replace("-", " ").strip().capitalize() or "Measured",
        description=f"Measured ({responses.layout}): {listeners} places of the listener, {emitters} of the emitter.",
        bounds=Bounds(
            minimum=_point(positions.min(axis=0) - _MARGIN_M), maximum=_point(positions.max(axis=0) + _MARGIN_M)
        ),
        speed_of_sound=SPEED_OF_SOUND,
        direct_sound="field",
        reference_level_db=round(_reference_level_db(responses), 2),
        channels=("mono",) if responses.channels == 1 else ("left", "right"),
        start=Start(
            listener=_point(responses.listener[usual]),
            listener_yaw_deg=round(float(np.degrees(np.arctan2(offset[usual, 1], offset[usual, 0]))), 1),
            emitter=_point(responses.emitter[usual]),
        ),
        codec=fields.codec,
        fields=fields.fields,
        levels=fields.levels,
        files=fields.files,
    )


def _reference_level_db(responses: ImportedDataset) -> float:
    """Median level of the direct sound, scaled to one metre from the emitter by spherical spreading.

    Raises ResponsesError if most responses are silent when the direct sound should arrive.
    """
    rows = np.sort(np.random.default_rng(0).permutation(len(responses.yaw))[:_LEVELLED_ROWS])
    energies = []
    for row in rows:
        first, last = (round((responses.onset_s[row] + offset) * responses.sample_rate) for offset in _DIRECT_S)
        direct = responses.read([row])[0, :, max(first, 0) : last].astype(np.float64)
        distance_m = np.linalg.norm(responses.emitter[row] - responses.listener[row])
        energies.append(np.square(direct).sum(axis=-1).mean() * distance_m**2)
    median = float(np.median(energies))
    if not median > 0:
        problem = "are silent when the direct sound should arrive; import them again: does the equipment delay them?"
        raise ResponsesError(responses.file, "responses", problem)
    return float(power_to_db(median))


def _point(position: np.ndarray) -> Point:
    """A position rounded to a tenth of a millimetre."""
    x, y, z = (round(float(coordinate), 4) for coordinate in position)
    return x, y, z
