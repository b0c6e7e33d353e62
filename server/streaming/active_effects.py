"""Makes a renderer produce the sound that a session's effects call for, and nothing else.

Direct sound with a fixed delay is *baked*: it is part of the impulse response (IR), and the renderer only keeps its
delay line running. The IR without direct sound is stored, so that the direct sound can follow poses from the next block
on when something moves.
"""

import dataclasses
from collections.abc import Mapping

from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.spherical_harmonics import harmonic_count
from server.planning.catalogue import ENERGY_EFFECTS, emitter_effects
from server.planning.planned_effects import PlannedEffects
from server.rendering.convolver import PartitionedIr, Sharing
from server.rendering.renderer import Renderer
from server.responses.effect_flags import EmitterEffects, SharedEffects
from server.responses.emitter_state import EmitterState
from server.responses.radiation import reverberation_gain
from server.scene.effects import EffectName
from server.streaming.emitters import StreamedEmitter


class ActiveEffects:
    """The effects now active in one session. `has_early` and `has_late` say which sound the scene has besides the
    direct sound. Without `planned` effects all are on."""

    def __init__(
        self, renderer: Renderer, planned: PlannedEffects | None, *, sample_rate: int, has_early: bool, has_late: bool
    ) -> None:
        self.planned = planned
        self._renderer = renderer
        self._bus: int | None = None
        self.shared = self._called_for()
        self._sample_rate = sample_rate
        has = {EffectName.EARLY_REFLECTIONS: has_early, EffectName.LATE_REVERBERATION: has_late}
        self._lacking = frozenset(name for name, is_there in has.items() if not is_there)

    @property
    def bus(self) -> int | None:
        """The order of the bus of the wanted quality level; None where emitters have responses of two ears."""
        return self._bus

    @bus.setter
    def bus(self, order: int | None) -> None:
        self._bus = order
        if self.planned is not None:
            self.planned.hear_by_bus(order)

    @property
    def clock_s(self) -> float:
        """Seconds of sound rendered so far."""
        return self._renderer.sample_clock / self._sample_rate

    @property
    def _wanted_channels(self) -> int:
        """The number of channels of responses that output, effects and quality level call for."""
        if self._renderer.order is not None:
            return self._renderer.channels
        if self.shared.head and self.bus is not None:
            return harmonic_count(self.bus)
        return self.shared.channels

    @property
    def wants_other_ears(self) -> bool:
        """Whether other channels are called for than the renderer has."""
        return self._wanted_channels != self._renderer.channels

    @property
    def awaits_ears(self) -> bool:
        """Whether other channels are called for, and the renderer has room to switch."""
        return self.wants_other_ears and self._renderer.can_set_channels(self._wanted_channels)

    @property
    def channels(self) -> int:
        """The number of channels of the IRs to request."""
        return self._wanted_channels if self.awaits_ears else self._renderer.channels

    @property
    def turns_ask(self) -> bool:
        """Whether a turn of the head asks for responses: those of two ears are of one orientation, while a bus turns by
        itself."""
        return self.shared.head and self.shared.head_rotation and self.channels == 2

    def bakes(self, emitter: StreamedEmitter) -> bool:
        """Whether the direct sound of an emitter belongs into its response. In a bus it would lose its direction."""
        effects = emitter.effects
        return effects.bakes_direct and (self._renderer.order is not None or self.channels <= 2 or effects.holds_still)

    def enforce(self, emitters: Mapping[str, StreamedEmitter]) -> list[str]:
        """Put the plan into effect. Return the emitters that it includes for the first time and that need no IR."""
        assert self.planned is not None
        ears = self._wanted_channels
        self.shared = self._called_for()
        begin = []
        for name, emitter in emitters.items():
            effects = self.planned.of_emitter(name, self.clock_s, lacking=self._lacking)
            if effects is None:
                continue
            if not emitter.is_decided and not effects.has_response:
                begin.append(name)
            self._switch(name, emitter, effects)
            emitter.decide()
            if ears != self._wanted_channels:
                emitter.discard_response()
        return begin

    def _called_for(self) -> SharedEffects:
        """The shared effects that the plan calls for; ambisonic channels have no head, whatever a client wishes."""
        shared = SharedEffects() if self.planned is None else self.planned.shared
        return shared if self._renderer.order is None else dataclasses.replace(shared, head=False)

    def whole(self) -> tuple[EmitterEffects, bool]:
        """Return the flags with every effect on but those switched off by hand, and whether there is a head then."""
        assert self.planned is not None
        off = {name for name, is_on in self.planned.overrides.items() if not is_on}
        told = {effect.name for effect in ENERGY_EFFECTS} - off - self._lacking
        whole = emitter_effects(told | {EffectName.PROPAGATION_DELAY})
        return whole, self.planned.output == "headphones" and EffectName.HRTF not in off

    def share(self, sharing: Sharing, emitters: Mapping[str, StreamedEmitter]) -> None:
        """Make emitters share what the quality calls for, and at least a late tail if the plan finds no audible
        difference."""
        several = sum(emitter.effects.late for emitter in emitters.values()) > 1
        planned = Sharing.TAIL if several and not self.shared.own_tails else Sharing.NOTHING
        self._renderer.share(max(sharing, planned))

    def as_asked(self, emitter: StreamedEmitter) -> EmitterState:
        """Return the state to request an IR for. The direct sound is baked only once there is an IR of the pose without
        it."""
        effects = emitter.effects
        if not effects.bakes_direct or (self.bakes(emitter) and (emitter.wants_baking or effects.holds_still)):
            return emitter.state
        return dataclasses.replace(emitter.state, effects=dataclasses.replace(effects, propagation_delay=True))

    def wants_baking(self, emitter: StreamedEmitter) -> bool:
        """Whether the direct sound is to be baked into an IR that is otherwise up to date."""
        return emitter.wants_baking and self.bakes(emitter)

    def accept_ir(
        self, name: str, emitter: StreamedEmitter, ir: PartitionedIr, asked: EmitterEffects, token: int
    ) -> bool:
        """Give the renderer an IR that was requested with certain effects. Return False if other effects are active by
        now."""
        if not emitter.effects.has_response or (asked.early, asked.late) != (
            emitter.effects.early,
            emitter.effects.late,
        ):
            return False
        if asked.bakes_direct:
            if asked != emitter.effects:  # its direct sound has the effects of an earlier state
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
        """Make the direct sound follow poses again, from the next block on."""
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
            if emitter.heard.bakes_direct:  # there is no IR without direct sound to fall back on
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
