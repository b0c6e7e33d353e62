"""The quality levels that a bundle could offer: every field with every method of finding its phase, and of reusing
responses.

Shorter responses are not among them. Room parameters depend only on the first 35 dB of a decay, so they would not show
that the rest was cut off.
"""

from collections.abc import Iterable, Iterator

from server.core.errors import BundleError
from server.field.kinds.catalogue import KINDS
from server.rendering.head_decoder import ORDERS
from server.scene.bundle import Bundle
from server.scene.manifest import FieldFile, Manifest, Phase, QualityLevel

NONE = "none"
"""Stands for no field, in place of a field's name."""
GRIFFIN_LIM_ITERATIONS = (1, 4, 16, 64)


def candidates(
    bundle: Bundle, phases_of: Iterable[str] | None = None, reuse_of: Iterable[str] = ()
) -> list[QualityLevel]:
    """One level per combination, named after what distinguishes it.

    `phases_of` names the fields for which all methods of finding the phase are measured, by default all fields; the
    time of Griffin and Lim's iteration does not depend on the field. `reuse_of` names the fields for which all kinds
    of reuse are measured. Either may be `NONE`. A field of directions is measured at each order, with both ways to make
    the tail, and by a bus of each order; it has no reuse. Raises BundleError for a name that is
    not a field, or for reuse of directions.
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
    if directional := sorted(name for name in reused - {NONE} if fields[name].order is not None):
        raise BundleError(
            bundle.folder, f"fields.{directional[0]}", "predicts directions, of which no response is reused"
        )
    levels = [level for name, file in fields.items() for level in _levels(bundle.manifest, name, file, name in swept)]
    return [*levels, *(level for name in fields if name in reused for kind in KINDS for level in kind.candidates(name))]


def _levels(manifest: Manifest, name: str, file: FieldFile, with_phases: bool) -> Iterator[QualityLevel]:
    yield QualityLevel(name=name, field=name)
    if file.order is not None:
        yield QualityLevel(name=f"{name}-bands", field=name, tail="bands")
        for order in range(file.order):
            yield QualityLevel(name=f"{name}-o{order}", field=name, order=order)
            yield QualityLevel(name=f"{name}-o{order}-bands", field=name, order=order, tail="bands")
        # Responses of a bus do not depend on the tail. Its first reflections are sharper with each order, whatever the
        # field's.
        for order in ORDERS:
            yield QualityLevel(name=f"{name}-bus{order}", field=name, bus=order)
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
