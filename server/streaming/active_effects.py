"""Has a renderer make what a session's effects call for, and nothing else.

Direct sound that stands still is *baked*: it is part of the impulse response (IR), and the renderer does no more for it
than keep the delay line. The IR without it is kept, so that it follows with the next block when something moves.
"""

import dataclasses
from collections.abc import Mapping

from server.acoustics.directivity import OMNIDIRECTIONAL
from server.planning.catalogue import ENERGY_EFFECTS, emitter_effects
from server.planning.planned_effects import PlannedEffects
from server.rendering.convolver import PartitionedIr
from server.rendering.renderer import Renderer
from server.responses.effect_flags import EmitterEffects, SharedEffects
from server.responses.emitter_state import EmitterState
from server.responses.radiation import reverberation_gain
from server.scene.effects import EffectName
from server.streaming.emitters import StreamedEmitter


class ActiveEffects:
    """Of one session. `has_early` and `has_late` say what a scene has beside direct sound. Without `planned` effects
    all are on."""

    def __init__(
        self, renderer: Renderer, planned: PlannedEffects | None, *, sample_rate: int, has_early: bool, has_late: bool
    ) -> None:
        self.planned = planned
        self.shared = SharedEffects() if planned is None else planned.shared
        self._renderer = renderer
        self._sample_rate = sample_rate
        has = {EffectName.EARLY_REFLECTIONS: has_early, EffectName.LATE_REVERBERATION: has_late}
        self._lacking = frozenset(name for name, is_there in has.items() if not is_there)

    @property
    def clock_s(self) -> float:
        """Seconds of sound so far."""
        return self._renderer.sample_clock / self._sample_rate

    @property
    def wants_other_ears(self) -> bool:
        """Whether another number of ears is called for than everything is heard with."""
        return self.shared.channels != self._renderer.channels

    @property
    def awaits_ears(self) -> bool:
        """Whether other ears are called for, and there is room to switch."""
        return self.wants_other_ears and self._renderer.can_hear_with(self.shared.channels)

    @property
    def channels(self) -> int:
        """Of the IRs to ask for."""
        return self.shared.channels if self.awaits_ears else self._renderer.channels

    def enforce(self, emitters: Mapping[str, StreamedEmitter]) -> list[str]:
        """Put the plan into effect. Emitters that are decided about by it for the first time and have no IR to wait
        for."""
        assert self.planned is not None
        ears = self.shared.channels
        self.shared = self.planned.shared
        begin = []
        for name, emitter in emitters.items():
            effects = self.planned.of_emitter(name, self.clock_s, lacking=self._lacking)
            if effects is None:
                continue
            if not emitter.is_decided and not effects.has_response:
                begin.append(name)
            self._switch(name, emitter, effects)
            emitter.decide()
            if ears != self.shared.channels:
                emitter.discard_response()
        return begin

    def whole(self) -> tuple[EmitterEffects, bool]:
        """What would be on if all were but what was switched off by hand, and whether that has a head."""
        assert self.planned is not None
        off = {name for name, is_on in self.planned.overrides.items() if not is_on}
        told = {effect.name for effect in ENERGY_EFFECTS} - off - self._lacking
        whole = emitter_effects(told | {EffectName.PROPAGATION_DELAY})
        return whole, self.planned.output == "headphones" and EffectName.HRTF not in off

    def share_tail(self, is_shared: bool, emitters: Mapping[str, StreamedEmitter]) -> None:
        """Have emitters share a late tail where a quality level does, or none would be told from its own."""
        several = sum(emitter.effects.late for emitter in emitters.values()) > 1
        self._renderer.share_tail(is_shared or (several and not self.shared.own_tails))

    def accept_ir(
        self, name: str, emitter: StreamedEmitter, ir: PartitionedIr, asked: EmitterEffects, token: int
    ) -> bool:
        """Hand the renderer an IR that was asked for with some effects. False where others are in force by now."""
        if not emitter.effects.has_response or (asked.early, asked.late) != (
            emitter.effects.early,
            emitter.effects.late,
        ):
            return False
        if asked.bakes_direct:
            if asked != emitter.effects:  # it holds the direct sound as it was to be heard
                emitter.is_outdated = True
                return False
            if emitter.is_outdated and not emitter.effects.holds_still:
                return False
            self._renderer.set_ir(name, ir, token=token)
            self._set_direct(name, emitter, bakes_direct=True)
        else:
            self._renderer.set_ir(name, ir, token=token)
            self._set_direct(name, emitter, bakes_direct=False)
            emitter.heard.without_direct = ir
        emitter.heard.token = token
        return True

    def unbake(self, name: str, emitter: StreamedEmitter) -> None:
        """Have the direct sound follow poses again, with the next block."""
        heard = emitter.heard
        if not heard.bakes_direct or emitter.effects.holds_still:
            return
        if heard.without_direct is not None and heard.without_direct.channels == self._renderer.channels:
            self._renderer.set_ir(name, heard.without_direct, token=heard.token)
            self._set_direct(name, emitter, bakes_direct=False)

    def _switch(self, name: str, emitter: StreamedEmitter, effects: EmitterEffects) -> None:
        before = emitter.effects
        emitter.set_effects(effects)
        if before == effects and emitter.is_decided:
            return
        if before.path != effects.path:
            emitter.is_displaced = True
        if before.directivity != effects.directivity and emitter.state.pattern != OMNIDIRECTIONAL:
            self._renderer.set_reverberation_gain(name, reverberation_gain(emitter.state.directivity))
            emitter.discard_response()
        if (before.early, before.late) != (effects.early, effects.late):
            emitter.discard_response()
        if not effects.has_response:
            self._renderer.drop_ir(name)
            emitter.heard.bakes_direct, emitter.heard.without_direct = False, None
        elif emitter.heard.bakes_direct and (not effects.bakes_direct or before != effects):
            self.unbake(name, emitter)
            if emitter.heard.bakes_direct:  # in a response that nothing stands for
                emitter.discard_response()
        self._set_direct(name, emitter, bakes_direct=emitter.heard.bakes_direct)

    def _set_direct(self, name: str, emitter: StreamedEmitter, *, bakes_direct: bool) -> None:
        emitter.heard.bakes_direct = bakes_direct
        effects = emitter.effects
        self._renderer.enable_direct(
            name,
            is_heard=effects.direct_path and not bakes_direct,
            distance=effects.distance_attenuation,
            air=effects.air_absorption,
        )


def as_asked(emitter: StreamedEmitter) -> EmitterState:
    """The state to ask for an IR of. Before the direct sound is baked, there has to be an IR of the pose without it."""
    effects = emitter.effects
    if not effects.bakes_direct or emitter.wants_baking or effects.holds_still:
        return emitter.state
    return dataclasses.replace(emitter.state, effects=dataclasses.replace(effects, propagation_delay=True))
