"""Checks a plan of effects: compares one emitter at one moment, rendered by the plan, with the same rendered with
everything on.

Full responses at the present poses are compared, in just-noticeable differences (JND). They do not show effects that
only motion shows (a delay that follows, responses that turn with the head). Effects that a client switched by hand do
not count. If a check finds an audible difference, it corrects the plan: of the effects that are off, the one that
reduces the difference most is on from then on.
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
"""Seconds of sound between checks, or more where checks take more than their share of time."""
SHARE = 0.01
"""Share of a core that the checks of one stream may take."""
SHARE_OF_ALL = 0.02
"""Share of a core that the checks of all streams of an audio thread may take."""
LIMIT_JND = 1.0


def interval_s(cost_s: float, *, streams: int) -> float:
    """Return the seconds of sound until the next check, after one that took `cost_s` of CPU time, with `streams` that
    share a core."""
    return max(PERIOD_S, cost_s / min(SHARE, SHARE_OF_ALL / streams))


@dataclass(frozen=True)
class Regret:
    """The result of a check: differences in JND by audible parameter. `corrections` are effects to switch on, with the
    reasons. `cost_s` is CPU time."""

    by_parameter: Mapping[str, float]
    corrections: Mapping[EffectName, str]
    cost_s: float

    @property
    def is_heard(self) -> bool:
        return max(self.by_parameter.values(), default=0.0) >= LIMIT_JND


@dataclass(frozen=True)
class PlanAudit:
    """A check of one emitter in a past state. `whole` has all effects on but those switched off by hand; `channels` is
    the number that is rendered, and `whole_channels` the number with `whole`."""

    level: str
    listener: Pose
    emitter: EmitterState
    whole: EmitterEffects
    channels: int
    whole_channels: int
    direct_sound: DirectSound

    @property
    def finds_anything(self) -> bool:
        """Whether an effect is off whose absence could be heard at a single moment."""
        still = dataclasses.replace(self.emitter.effects, propagation_delay=True, holds_still=False)
        return still != self.whole or self.channels != self.whole_channels

    def run(self, field: AcousticField) -> Regret:
        """Make the comparison, which takes tens of milliseconds, on a worker thread."""
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
        """Return the full response (2, sample); a mono one is repeated, and ambisonic channels are heard by two
        cardioid microphones, back to back."""
        emitter = dataclasses.replace(self.emitter, effects=dataclasses.replace(effects, propagation_delay=True))
        responses: npt.NDArray[np.float32] = composed_irs(field, self.direct_sound, self.listener, [emitter], channels)
        if effects.direct_path:
            self.direct_sound.add(responses, self.listener, [emitter])
        if channels == 1:
            return np.repeat(responses[0], 2, axis=0)
        if channels == 2:
            return np.asarray(responses[0])
        pressure, to_the_left = responses[0, :2]
        return np.array([pressure + to_the_left, pressure - to_the_left], np.float32) / np.float32(2)


@dataclass
class RegretRecord:
    """The results of all checks so far."""

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
