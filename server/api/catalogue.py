"""What a server offers: scenes with their fields, clips and heads."""

import logging
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from server.acoustics.mesh import TriangleMesh
from server.assets.clips import Clip, ClipLibrary, DecodeError
from server.assets.hrtfs import HrtfLibrary
from server.assets.names import named_by_stem
from server.core.errors import BundleError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.codecs import libopus
from server.protocol.codecs.registry import CODECS, OPUS_MEANING
from server.protocol.server_messages import DoorDescription, Place, SceneDescription, Storey
from server.scene.bundle import MANIFEST_FILE, Bundle, bundled_scenes
from server.scene.door import Door
from server.scene.outline import hull_in_plan
from server.scene.signatures import BundleKeys

_logger = logging.getLogger(__name__)


def load_scenes(bundles: Iterable[Path], *, keys: BundleKeys | None = None) -> dict[str, FieldsByLevel]:
    """Quality levels by scene id, of the bundled scenes and of `bundles`, which replace bundled scenes of the same id,
    and have to be signed by one of the `keys` if there are any.

    Raises BundleError for the first bundle that is damaged or has the id of another of `bundles`.
    """
    own: dict[str, Bundle] = {}  # read first, so that their errors appear before the bundled graphs are loaded
    for folder in bundles:
        bundle = Bundle.load(folder, keys=keys)
        other = own.setdefault(bundle.id, bundle)
        if other.folder.resolve() != folder.resolve():
            problem = f"is {bundle.id!r}, and so is that of {other.folder}; leave one out, or change one"
            raise BundleError(folder / MANIFEST_FILE, "id", problem)
    shipped = [Bundle.load(folder) for folder in bundled_scenes()]
    return {bundle.id: FieldsByLevel.load(bundle) for bundle in ({each.id: each for each in shipped} | own).values()}


def load_hrtfs(files: Iterable[Path], scenes: Mapping[str, FieldsByLevel]) -> HrtfLibrary:
    """Heads for the sample rates of the scenes. Raises HrtfError for the first file that cannot be used."""
    return HrtfLibrary(files, {levels.default.sample_rate for levels in scenes.values()})


def open_clips(scenes: Mapping[str, FieldsByLevel], files: Iterable[Path]) -> dict[str, ClipLibrary]:
    """Clips by scene id. Scenes of one sample rate share a library, and files are named by their stem.

    Raises ValueError if two files have the same stem.
    """
    named = named_by_stem(files)
    rates = {scene: levels.default.sample_rate for scene, levels in scenes.items()}
    by_rate = {rate: ClipLibrary(rate, named) for rate in set(rates.values())}
    return {scene: by_rate[rate] for scene, rate in rates.items()}


def describe_encodings() -> list[dict[str, Any]]:
    """Encodings of the live stream, by name, each with the sample rates that it has; None where it has any."""
    described: list[dict[str, Any]] = [
        {"name": name, "meaning": codec.meaning, "sample_rates": None} for name, codec in CODECS.items()
    ]
    if libopus.is_available():
        described.append({"name": "opus", "meaning": OPUS_MEANING, "sample_rates": libopus.RATES})
    return described


def playable_clips(clips: ClipLibrary) -> list[Clip]:
    """Descriptions of all clips that can be decoded. The log says why the others cannot."""
    playable = []
    for name in clips.names:
        try:
            playable.append(clips.describe(name))
        except DecodeError as exc:
            _logger.warning("clip left out: %s", exc)
    return playable


def _leaves(bundle: Bundle) -> tuple[TriangleMesh, ...]:
    return () if bundle.moving is None else tuple(leaf.mesh for leaf in bundle.moving.leaves)


def _describe_door(door: Door, leaf: TriangleMesh) -> DoorDescription:
    (_, _, bottom_m), (_, _, top_m) = leaf.bounds_m.tolist()
    return DoorDescription(
        name=door.name,
        kind=door.kind,
        pivot=door.pivot,
        angle_deg=door.angle_deg,
        slide_m=door.slide_m,
        openness=door.openness,
        footprint=tuple((round(x, 4), round(y, 4)) for x, y in hull_in_plan(leaf.corners_m.reshape(-1, 3))),
        bottom_m=round(bottom_m, 4),
        top_m=round(top_m, 4),
    )


def _storeys(bundle: Bundle) -> tuple[Storey, ...]:
    floors_m = bundle.floors_m
    if bundle.mesh is None or not floors_m:
        return ()
    tops_m = (*floors_m[1:], float(bundle.mesh.bounds_m[1, 2]))
    return tuple(Storey(floor_m=round(low, 3), top_m=round(top, 3)) for low, top in zip(floors_m, tops_m, strict=True))


def describe_scene(levels: FieldsByLevel) -> SceneDescription:
    field, manifest = levels.at_rate(None).default, levels.bundle.manifest
    start, plan = manifest.start, levels.bundle.floor_plan
    return SceneDescription(
        id=manifest.id,
        name=manifest.name,
        description=manifest.description,
        sample_rate=field.sample_rate,
        sample_rates=levels.sample_rates,
        ir_samples=field.ir_samples,
        channels=manifest.channels,
        speed_of_sound=manifest.speed_of_sound,
        bounds=manifest.bounds,
        walls_known=manifest.geometry is not None,
        corners=plan.corners,
        height_m=plan.height_m - plan.floor_m,
        openings=() if manifest.geometry is None else manifest.geometry.openings,
        is_mesh=manifest.mesh is not None,
        storeys=_storeys(levels.bundle),
        doors=tuple(map(_describe_door, levels.bundle.doors, _leaves(levels.bundle))),
        listener=Place(position=start.listener, yaw=math.radians(start.listener_yaw_deg)),
        emitter=Place(position=start.emitter),
        level=field.level.name,
        levels=manifest.levels,
        directional_levels=tuple(name for name in levels if levels[name].knows_directions),
        accepted_laws=manifest.accepted,
    )
