"""Which quality levels a bundle could offer: every field with every way of finding its phase.

Shorter responses are not among them: room parameters are taken from the first 35 dB of a decay and would not hear that
the rest was cut off, so cutting it would always seem to be worth the time it saves.
"""

from collections.abc import Iterable, Iterator

from server.scene.bundle import Bundle
from server.scene.manifest import FieldFile, Manifest, Phase, QualityLevel

GRIFFIN_LIM_ITERATIONS = (1, 4, 16, 64)


def candidates(bundle: Bundle, phases_of: Iterable[str] | None = None) -> list[QualityLevel]:
    """One level per combination worth measuring, named after what sets it apart.

    Swept over phases are the fields that `phases_of` names, by default all: what Griffin and Lim's iteration adds in
    time does not depend on the field beneath.
    """
    fields = bundle.manifest.fields
    swept = set(fields) if phases_of is None else set(phases_of)
    return [level for name, file in fields.items() for level in _levels(bundle.manifest, name, file, name in swept)]


def _levels(manifest: Manifest, name: str, file: FieldFile, with_phases: bool) -> Iterator[QualityLevel]:
    yield QualityLevel(name=name, field=name)
    # A field in the time domain predicts samples: there is no phase to choose.
    if not with_phases or file.architecture.endswith("time-domain"):
        return
    codec = file.codec or manifest.codec
    if codec.known_frames == codec.codec.frames:
        yield QualityLevel(name=f"{name}-if", field=name, phase=Phase(kind="integrated"))
    for iterations in GRIFFIN_LIM_ITERATIONS:
        for warm, suffix in ((False, ""), (True, "-warm")):
            phase = Phase(kind="griffin_lim", iterations=iterations, warm=warm)
            yield QualityLevel(name=f"{name}-gl{iterations}{suffix}", field=name, phase=phase)
