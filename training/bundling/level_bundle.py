"""A level as a scene bundle without a field: its mesh, from which the server computes direct sound, paths round edges,
sound through walls and first reflections."""

import math
from pathlib import Path

from server.scene.bundle import MOST_TRIANGLES, Bundle, write_bundle
from server.scene.door import MOST_DOORS
from server.scene.limits import MOST_SAMPLES
from server.scene.manifest import (
    MESH_FORMAT,
    NO_FIELD,
    Bounds,
    CodecParameters,
    Manifest,
    QualityLevel,
)
from training.bundling.manifests import mesh_files, rendered_effects
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import SceneFileError

_SAMPLE_RATE, _N_FFT, _HOP = 48_000, 512, 128
_SHORTEST_S, _AFTER_S = 0.25, 0.05
"""A response lasts at least so long, and so much longer than a reflection across the whole place."""


def require_bundled(scene: LevelScene) -> None:
    """Raises SceneFileError for more triangles or doors than a bundle may have, and for a start that is not in the
    air."""
    triangles = len(scene.place.mesh.triangles)
    if triangles > MOST_TRIANGLES:
        raise SceneFileError(
            f"{scene.id}: geometry.mesh: {triangles:,} triangles with its doors, and a bundle has at "
            f"most {MOST_TRIANGLES:,}: import the level with a larger --merge-within-m, or with less detail"
        )
    if len(scene.doors) > MOST_DOORS:
        raise SceneFileError(
            f"{scene.id}: geometry.doors: {len(scene.doors)}, and a bundle has at most {MOST_DOORS}: leave those that "
            "never move in the mesh, under another name than door_..."
        )
    for name, position in (("listener", scene.file.start.listener), ("emitter", scene.file.start.emitter)):
        if not scene.surroundings.holds(position):
            problem = "is not in the air: it is inside something, or outside"
            raise SceneFileError(f"{scene.id}: start.{name}: {position} {problem}")


def bundle_of_level(scene: LevelScene, folder: Path) -> Bundle:
    """Write the bundle, whose doors move, and load it back. Raises SceneFileError for what a bundle cannot hold."""
    require_bundled(scene)
    place = scene.place
    (west, south, low), (east, north, high) = place.mesh.bounds_m.tolist()
    longest_s = 2 * math.dist((west, south, low), (east, north, high)) / SPEED_OF_SOUND + _AFTER_S
    samples = _HOP * math.ceil(max(_SHORTEST_S, longest_s) * _SAMPLE_RATE / _HOP)
    mesh, files = mesh_files(scene, moving=True)
    manifest = Manifest(
        format_version=MESH_FORMAT,
        id=scene.id,
        name=scene.file.name,
        description=scene.file.description,
        mesh=mesh,
        bounds=Bounds(minimum=(west, south, low), maximum=(east, north, high)),
        speed_of_sound=SPEED_OF_SOUND,
        air=scene.air,
        image_order=GEOMETRIC_ORDER,
        transmission=any(material.surface_mass_kg_m2 for material in place.materials.values()),
        start=scene.file.start,
        effects=rendered_effects(scene),
        codec=CodecParameters(
            sample_rate=_SAMPLE_RATE,
            n_fft=_N_FFT,
            hop=_HOP,
            samples=min(samples, MOST_SAMPLES),
            lead_samples=0,
            known_frames=0,
            log_floor=1e-3,
        ),
        fields={},
        levels=(QualityLevel(name="geometry", field=NO_FIELD),),
        files=dict.fromkeys(files, "0" * 64),
    )
    return write_bundle(folder, manifest, files)
