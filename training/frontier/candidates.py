"""Which quality levels a bundle could offer: every field with every way of finding its phase, and of reusing responses.

Shorter responses are not among them: room parameters are taken from the first 35 dB of a decay and would not hear that
the rest was cut off, so cutting it would always seem to be worth the time it saves.
"""

from collections.abc import Iterable, Iterator

from server.core.errors import BundleError
from server.field.kinds.catalogue import KINDS
from server.scene.bundle import Bundle
from server.scene.manifest import FieldFile, Manifest, Phase, QualityLevel

NONE = "none"
"""Instead of a field's name: no field."""
GRIFFIN_LIM_ITERATIONS = (1, 4, 16, 64)


def candidates(
    bundle: Bundle, phases_of: Iterable[str] | None = None, reuse_of: Iterable[str] = ()
) -> list[QualityLevel]:
    """One level per combination worth measuring, named after what sets it apart.

    Swept over phases are the fields that `phases_of` names, by default all: what Griffin and Lim's iteration adds in
    time does not depend on the field beneath. Swept over all that may be reused
    are those that `reuse_of` names; either may name `NONE`. Raises BundleError for a name that is no field.
    """
    fields = bundle.manifest.fields
    reused = set(reuse_of)
    swept = set(fields) if phases_of is None else set(phases_of)
    if unknown := sorted((swept | reused) - {*fields, NONE}):
        raise BundleError(bundle.folder, "fields", f"there is no {unknown[0]!r}, only {', '.join(fields)}")
    for named in (swept, reused):
        if NONE in named and len(named) > 1:
            other = min(named - {NONE})
            raise BundleError(bundle.folder, "fields", f"{NONE!r} and {other!r} contradict each other: leave one out")
    levels = [level for name, file in fields.items() for level in _levels(bundle.manifest, name, file, name in swept)]
    return [*levels, *(level for name in fields if name in reused for kind in KINDS for level in kind.candidates(name))]


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
