"""What a server offers: scenes with their fields, clips to hear in them, and heads to hear them through."""

import logging
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from server.clips import Clip, ClipLibrary, DecodeError
from server.field.field import AcousticField
from server.hrtfs import HrtfLibrary
from server.protocol import Place, SceneDescription
from server.scene.bundle import Bundle, bundled_scenes

_logger = logging.getLogger(__name__)


def load_fields(bundles: Iterable[Path]) -> dict[str, AcousticField]:
    """Fields by scene id: the bundled scenes, and `bundles`, which win where an id is taken.

    Raises BundleError for the first bundle that is damaged.
    """
    fields = {}
    for folder in (*bundled_scenes(), *bundles):
        bundle = Bundle.load(folder)
        fields[bundle.id] = AcousticField.load(bundle)
    return fields


def load_hrtfs(files: Iterable[Path], fields: Mapping[str, AcousticField]) -> HrtfLibrary:
    """Heads for the sample rates of the scenes. Raises HrtfError for the first file that cannot be used."""
    return HrtfLibrary(files, {field.sample_rate for field in fields.values()})


def open_clips(fields: Mapping[str, AcousticField], files: Iterable[Path]) -> dict[str, ClipLibrary]:
    """Clips by scene id; scenes of one sample rate share a library, and files are named by their stem."""
    named = {path.stem: path for path in files}
    by_rate = {rate: ClipLibrary(rate, named) for rate in {field.sample_rate for field in fields.values()}}
    return {scene: by_rate[field.sample_rate] for scene, field in fields.items()}


def playable_clips(clips: ClipLibrary) -> list[Clip]:
    """Every clip that can be decoded, decoded; the log says of the others why not."""
    playable = []
    for name in clips.names:
        try:
            playable.append(clips.describe(name))
        except DecodeError as exc:
            _logger.warning("clip left out: %s", exc)
    return playable


def describe_scene(field: AcousticField) -> SceneDescription:
    manifest = field.bundle.manifest
    start = manifest.start
    return SceneDescription(
        id=manifest.id,
        name=manifest.name,
        description=manifest.description,
        sample_rate=field.sample_rate,
        ir_samples=field.ir_samples,
        channels=manifest.channels,
        speed_of_sound=manifest.speed_of_sound,
        bounds=manifest.bounds,
        corners=manifest.geometry.corners,
        height_m=manifest.geometry.height_m,
        openings=manifest.geometry.openings,
        listener=Place(position=start.listener, yaw=math.radians(start.listener_yaw_deg)),
        emitter=Place(position=start.emitter),
        level=field.level.name,
        levels=manifest.levels,
    )
