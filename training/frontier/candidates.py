"""Which quality levels a bundle could offer: every field with every way of finding its phase and every length."""

from collections.abc import Iterable, Iterator

from server.scene.bundle import Bundle
from server.scene.manifest import FieldFile, Manifest, Phase, QualityLevel

GRIFFIN_LIM_ITERATIONS = (1, 4, 16, 64)
FRAME_SHARES = (0.5, 0.25)


def candidates(bundle: Bundle, phases_of: Iterable[str] | None = None) -> list[QualityLevel]:
    """One level per combination worth measuring, named after what sets it apart.

    Every field is swept over frames; over phases those that `phases_of` names (by default all), since what
    Griffin and Lim's iteration adds in time does not depend on the field beneath.
    """
    fields = bundle.manifest.fields
    swept = set(fields) if phases_of is None else set(phases_of)
    return [level for name, file in fields.items() for level in _levels(bundle.manifest, name, file, name in swept)]


def _levels(manifest: Manifest, name: str, file: FieldFile, with_phases: bool) -> Iterator[QualityLevel]:
    yield QualityLevel(name=name, field=name)
    if file.architecture.endswith("time-domain"):
        return  # it predicts samples: there is no phase to choose and no frame to leave out
    codec = file.codec or manifest.codec
    frames = codec.codec.frames
    for share in FRAME_SHARES:
        yield QualityLevel(name=f"{name}-{share:.0%}".replace("%", "pct"), field=name, frames=round(share * frames))
    if not with_phases:
        return
    if codec.known_frames == frames:
        yield QualityLevel(name=f"{name}-if", field=name, phase=Phase(kind="integrated"))
    for iterations in GRIFFIN_LIM_ITERATIONS:
        for warm, suffix in ((False, ""), (True, "-warm")):
            phase = Phase(kind="griffin_lim", iterations=iterations, warm=warm)
            yield QualityLevel(name=f"{name}-gl{iterations}{suffix}", field=name, phase=phase)
