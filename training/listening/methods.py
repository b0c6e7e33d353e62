"""The methods of a listening test by name: quality levels and fields of bundles, and baselines.

A name is that of a level in a bundle's manifest, of a level that the bundle could offer (`nafir-train frontier` lists
them), or of a field, which is heard at its plainest level. If there are several bundles, the folder's name and a space
come before it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.api.frontier import mean_jnd
from server.core.near_names import suggestion
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.listening.design import ANCHORS, REFERENCE, Method
from server.scene.bundle import Bundle
from server.scene.manifest import QualityLevel
from training.baselines.coded import Track
from training.baselines.held_out import EvaluationError, HeldOut, Responses, require_same_scene
from training.evaluation.evaluate import Source
from training.evaluation.fields import field_source, of_length
from training.evaluation.methods import METHODS, method_columns
from training.frontier.candidates import candidates
from training.frontier.heard_by_bus import full_response


@dataclass(frozen=True)
class HeardMethod:
    """A method with its responses at held-out pairs."""

    name: str
    method: Method
    source: Source


@dataclass(frozen=True)
class _OfBundle:
    """The levels of one bundle by the names under which a test may ask for them."""

    bundle: Bundle
    prefix: str

    @cached_property
    def levels(self) -> dict[str, QualityLevel]:
        manifest = self.bundle.manifest
        heard_by_ears = [name for name, file in manifest.fields.items() if file.order is None]
        could_be = {level.name: level for level in candidates(self.bundle, None, heard_by_ears)}
        measured = {point.level.name: point.level for point in manifest.frontier if point.level.name in could_be}
        offered = {level.name: level for level in manifest.levels}
        return {f"{self.prefix}{name}": level for name, level in (could_be | measured | offered).items()}

    @property
    def offered(self) -> tuple[str, ...]:
        return tuple(f"{self.prefix}{level.name}" for level in self.bundle.manifest.levels)

    def heard(self, name: str, held_out: HeldOut) -> HeardMethod:
        level = self.levels[name]
        manifest = self.bundle.manifest.model_copy(update={"levels": (level,)})
        field = FieldsByLevel.load(replace(self.bundle, manifest=manifest)).default
        source = field_source(field, held_out) if level.bus is None else _by_bus(field, held_out)
        jnd = None if level.accuracy is None else mean_jnd(level.accuracy.errors)
        return HeardMethod(name, Method(kind="field", jnd=jnd), source)


class MethodCatalogue:
    """All methods that a test with these bundles and data can ask about."""

    def __init__(self, bundles: Sequence[Bundle], held_out: HeldOut) -> None:
        """Raises DatasetError or EvaluationError for a bundle of another scene than the data."""
        for bundle in bundles:
            _require_same(bundle, held_out)
        prefixes = [f"{Path(bundle.folder).resolve().name} " if len(bundles) > 1 else "" for bundle in bundles]
        if len(set(prefixes)) < len(bundles):
            raise EvaluationError("BUNDLE: two folders have the same name, which tells their levels apart: rename one")
        self._bundles = [_OfBundle(bundle, prefix) for bundle, prefix in zip(bundles, prefixes, strict=True)]
        self._held_out = held_out

    @property
    def defaults(self) -> tuple[str, ...]:
        """The default level of each bundle."""
        return tuple(each.offered[0] for each in self._bundles)

    @property
    def offered(self) -> tuple[str, ...]:
        """All levels that the bundles offer."""
        return tuple(name for each in self._bundles for name in each.offered)

    def require(self, names: Sequence[str]) -> None:
        """Raises EvaluationError for a name that is unknown or given twice."""
        levels = [name for each in self._bundles for name in each.levels]
        for name in names:
            if name in ANCHORS:
                raise EvaluationError(f"--methods: {name} is an anchor, which every test has: leave it out")
            if name not in {REFERENCE, *METHODS, *levels}:
                known = {REFERENCE, *METHODS, *self.offered}
                hint = suggestion(name, [*known, *levels])
                listed = "" if "there is" in hint else f" (there is {', '.join(sorted(known))})"
                raise EvaluationError(f"--methods: there is no {name!r}{hint}{listed}")
            if list(names).count(name) > 1:
                raise EvaluationError(f"--methods: {name} is given twice: give it once")

    def heard(self, names: Sequence[str], track: Track) -> Mapping[str, HeardMethod]:
        """The methods by name, without the reference. `track` may show progress."""
        baselines = method_columns([name for name in names if self._is_baseline(name)], self._held_out, track)
        found = {each.name: HeardMethod(each.name, Method(kind="baseline"), each.source) for each in baselines}
        for name in names:
            for of_bundle in self._bundles:
                if name in of_bundle.levels:
                    found[name] = of_bundle.heard(name, self._held_out)
        return found

    def _is_baseline(self, name: str) -> bool:
        return name in METHODS and all(name not in of_bundle.levels for of_bundle in self._bundles)


def _require_same(bundle: Bundle, held_out: HeldOut) -> None:
    if held_out.simulated is not None:
        require_same_scene(bundle, held_out.simulated)
        return
    low, high = bundle.manifest.bounds.minimum, bundle.manifest.bounds.maximum
    ends = np.concatenate([held_out.listeners, held_out.emitters])
    if (ends < np.array(low) - _ROUNDING_M).any() or (ends > np.array(high) + _ROUNDING_M).any():
        raise EvaluationError(
            f"BUNDLE: {bundle.folder} is of scene {bundle.id}, and pairs of {held_out.folder} lie outside it: give the "
            "dataset that its field was trained on"
        )


def _by_bus(field: AcousticField, held_out: HeldOut) -> Source:
    whole = full_response(field)
    listeners, emitters = held_out.listeners, held_out.emitters

    def source(index: int, yaw_indices: npt.NDArray[np.integer]) -> Responses:
        shape = (len(yaw_indices), 3)
        listener, emitter = (np.broadcast_to(end[index], shape) for end in (listeners, emitters))
        return of_length(whole.impulse_responses(listener, emitter, held_out.yaws[yaw_indices]), held_out.samples)

    return source


_ROUNDING_M = 0.01
