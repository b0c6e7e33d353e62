"""Whether a plan of effects is right: a moment of one emitter, heard as planned and with everything on, compared.

Whole responses are compared where everybody is at that moment, in just-noticeable differences (JND). What only motion
tells (a delay that follows, responses that turn with the head) they do not show; what a client switched by hand is no
regret. A plan that is found out is corrected: of the effects that are off, the one that makes up for most is on from
then on.
"""

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from server.acoustics.difference import audible_difference
from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.planning.catalogue import emitter_effects, names_on
from server.responses.direct_sound import DirectSound
from server.responses.effect_flags import EmitterEffects
from server.responses.emitter_state import EmitterState
from server.responses.ir_request import composed_irs
from server.scene.effects import EffectName

FIRST_S = 2.0
PERIOD_S = 10.0
"""Of sound from one check to the next, or more where checks take more than their share of time."""
SHARE = 0.01
"""Of a core that the checks of one stream may take."""
SHARE_OF_ALL = 0.02
"""Of a core that those of all streams of an audio thread may take."""
LIMIT_JND = 1.0


def interval_s(cost_s: float, *, streams: int) -> float:
    """Of sound until the check after one that took `cost_s` of CPU time, with so many streams that share a core."""
    return max(PERIOD_S, cost_s / min(SHARE, SHARE_OF_ALL / streams))


@dataclass(frozen=True)
class Regret:
    """By audible parameter, in JND; `corrections` say why effects are to be on that were not. `cost_s` of CPU time."""

    by_parameter: Mapping[str, float]
    corrections: Mapping[EffectName, str]
    cost_s: float

    @property
    def is_heard(self) -> bool:
        return max(self.by_parameter.values(), default=0.0) >= LIMIT_JND


@dataclass(frozen=True)
class PlanAudit:
    """Of one emitter as it was. `whole` are the effects that would be on if all were but those switched off by hand;
    `channels` is what it is heard with, and `whole_channels` what it would be then."""

    level: str
    listener: Pose
    emitter: EmitterState
    whole: EmitterEffects
    channels: int
    whole_channels: int
    direct_sound: DirectSound

    @property
    def finds_anything(self) -> bool:
        """Whether anything is off that could be heard at one moment."""
        still = dataclasses.replace(self.emitter.effects, propagation_delay=True, holds_still=False)
        return still != self.whole or self.channels != self.whole_channels

    def run(self, field: AcousticField) -> Regret:
        """Tens of milliseconds, for a worker thread."""
        began_s = time.thread_time()
        reference = self._heard(field, self.whole, self.whole_channels)
        planned = self._compare(field, reference, self.emitter.effects, self.channels)
        corrections = {}
        if max(planned.values(), default=0.0) >= LIMIT_JND:
            corrections = self._correct(field, reference, planned)
        return Regret(planned, corrections, time.thread_time() - began_s)

    def _correct(
        self, field: AcousticField, reference: npt.NDArray[np.float32], planned: Mapping[str, float]
    ) -> dict[EffectName, str]:
        parameter = max(planned, key=planned.__getitem__)
        effects, left = self.emitter.effects, {}
        on = names_on(effects) | {EffectName.PROPAGATION_DELAY}
        for name in [name for name in EffectName if name in names_on(self.whole) - on]:
            with_it = emitter_effects(on | {name})
            left[name] = max(self._compare(field, reference, with_it, self.channels).values())
        if self.channels != self.whole_channels:
            left[EffectName.HRTF] = max(self._compare(field, reference, effects, self.whole_channels).values())
        if not left:
            return {}
        name = min(left, key=left.__getitem__)
        return {name: f"a check heard its absence: {planned[parameter]:.1f} JND of {parameter}"}

    def _compare(
        self, field: AcousticField, reference: npt.NDArray[np.float32], effects: EmitterEffects, channels: int
    ) -> dict[str, float]:
        heard = self._heard(field, effects, channels)
        onset_s = float(field.onset_s([self.listener.position], [self.emitter.position])[0])
        return audible_difference(reference, heard, field.sample_rate, onset_s=onset_s)

    def _heard(self, field: AcousticField, effects: EmitterEffects, channels: int) -> npt.NDArray[np.float32]:
        """(2, sample) the whole response; one ear's twice."""
        emitter = dataclasses.replace(self.emitter, effects=dataclasses.replace(effects, propagation_delay=True))
        responses = composed_irs(field, self.direct_sound, self.listener, [emitter], channels)
        if effects.direct_path:
            self.direct_sound.add(responses, self.listener, [emitter])
        return np.repeat(responses[0], 2, axis=0) if channels == 1 else responses[0]


@dataclass
class RegretRecord:
    """What checks found."""

    checks: int = 0
    failures: int = 0
    worst_jnd: dict[str, float] = field(default_factory=dict)

    def add(self, regret: Regret) -> None:
        self.checks += 1
        self.failures += regret.is_heard
        self._keep_worst(regret.by_parameter)

    def merge(self, other: "RegretRecord") -> None:
        self.checks += other.checks
        self.failures += other.failures
        self._keep_worst(dict(other.worst_jnd))  # another thread may be adding to it

    def _keep_worst(self, by_parameter: Mapping[str, float]) -> None:
        for parameter, jnd in by_parameter.items():
            self.worst_jnd[parameter] = max(self.worst_jnd.get(parameter, 0.0), jnd)
