"""Has a renderer make what follows a session's direct sound: the impulse responses (IRs) of its newest poses, at the
quality that was asked for last.

IRs are computed off the audio thread: `take_request` says which, one request at a time and always for the newest poses,
and whoever computes them brings them back through `accept`, or through `give_up` where none could be. A rung that takes
another level's IRs is heard from when they are there. Clocks are samples.
"""

from collections.abc import Hashable, Iterable, Mapping

from server.acoustics.geometry import Pose
from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.server_messages import EmitterAdded, Error, LevelChanged, LevelReason, ServerMessage
from server.rendering.renderer import Renderer
from server.responses.direct_sound import DirectSound
from server.responses.ir_cache import Shared, shared_response
from server.responses.ir_request import EmitterSnapshot, IrRequest, IrResponse
from server.streaming.active_effects import ActiveEffects, as_asked
from server.streaming.emitters import Emitter
from server.streaming.load import QualityStep


class ResponseScheduler:
    """Of one session, whose `emitters` are who sounds at each moment. `rung` is what is heard of `levels` first."""

    def __init__(
        self,
        renderer: Renderer,
        effects: ActiveEffects,
        emitters: Mapping[str, Emitter],
        *,
        levels: FieldsByLevel,
        direct_sound: DirectSound,
        rung: QualityStep,
    ) -> None:
        self.heard = rung
        """The quality that is heard."""
        self.newest_pose_id = 0
        self.applied_pose_id = 0
        """Of the poses whose IRs are heard."""
        self._renderer = renderer
        self._effects = effects
        self._emitters = emitters
        self._levels = levels
        self._sample_rate = levels.default.sample_rate
        self._direct_sound = direct_sound
        self._wanted = rung
        self._reason: LevelReason = "chosen"
        self._accepted_pose_id = 0
        self._in_flight: IrRequest | None = None
        self._is_partial = False
        """Whether that is for first IRs only, where others are out of date too."""
        self._has_changed = False
        """Whether anything has, since it was made, that may call for another."""
        self._waits_for_change = self._has_looked = False
        self._interval_s = 0.0
        self._next_request_clock = 0
        renderer.share_tail(rung.shared_tail)

    @property
    def are_awaited(self) -> bool:
        """Whether a request is unanswered, or it is too soon for the next; may be asked from any thread."""
        return self._in_flight is not None or self._renderer.sample_clock < self._next_request_clock

    @property
    def are_wanted(self) -> bool:
        """Whether there was something to ask for when it was looked last, and it is time to."""
        return self._has_looked and not self.are_awaited and not self._waits_for_change

    def set_quality(self, rung: QualityStep, reason: LevelReason) -> list[ServerMessage]:
        """Have IRs come from another rung: from now on, or, where it takes another level's, from when they are
        there."""
        if rung.level != self._wanted.level:
            for emitter in self._emitters.values():
                emitter.is_outdated = True
            self._look_again()
            self._next_request_clock = 0
        self._wanted, self._reason = rung, reason
        return self.change_rung() if rung.level == self.heard.level else self.change_rung_unheard()

    def change_rung_unheard(self) -> list[ServerMessage]:
        """Stand on the rung that was asked for last where no emitter has, or is to have, an IR that tells levels
        apart."""
        has_irs = any(not emitter.is_decided or emitter.effects.has_response for emitter in self._emitters.values())
        return [] if has_irs else self.change_rung()

    def change_rung(self) -> list[ServerMessage]:
        """Stand on the rung that was asked for last, with the block that follows."""
        if self._wanted == self.heard:
            return []
        self.heard = self._wanted
        self._effects.share_tail(self.heard.shared_tail, self._emitters)
        return [
            LevelChanged(
                level=self.heard.level,
                reason=self._reason,
                ir_rate_hz=self.heard.ir_rate_hz,
                shared_tail=self.heard.shared_tail,
                sample_clock=self._renderer.sample_clock,
            )
        ]

    def space(self, interval_s: float) -> None:
        """Have so much time pass from one request to the next, unless an emitter waits for its first."""
        self._interval_s = interval_s

    def advance(self, pose_id: int) -> None:
        """Something takes a pose. Raises RequestError where a newer one was taken before."""
        if pose_id <= self.newest_pose_id:
            raise RequestError("stale_pose", f"pose {pose_id} is not newer than {self.newest_pose_id}", field="pose_id")
        self.newest_pose_id = pose_id
        self._waits_for_change, self._has_changed = False, True
        if self._levels[self._wanted.level].level.reuse is not None:
            self._has_looked = False  # what is heard may be its response again

    def retry(self) -> None:
        """Look again at what to ask for: somebody has come, or is decided about."""
        self._look_again()

    def _look_again(self) -> None:
        """Something has changed that may call for an IR."""
        self._waits_for_change = self._has_looked = False
        self._has_changed = True

    def enforce_plan(self) -> list[ServerMessage]:
        """Put the plan of effects into effect, with the block that follows."""
        events = self._announce(self._effects.enforce(self._emitters))
        self._effects.share_tail(self.heard.shared_tail, self._emitters)
        self._look_again()
        return events + self.change_rung_unheard()

    def take_request(self, listener: Pose, *, only_first: bool = False) -> IrRequest | None:
        """The IRs to compute now. None while an earlier request is unanswered, when every IR is up to date, or where
        `only_first` ones may be asked for and none is the first of an emitter. Where it is not time for others, first
        ones are asked for alone."""
        if self._in_flight is not None or self._waits_for_change:
            return None
        clock = self._renderer.sample_clock
        is_held = only_first or clock < self._next_request_clock
        if is_held and self._has_looked:
            return None
        outdated = [emitter for emitter in self._emitters.values() if self._needs_ir(emitter, listener)]
        if not outdated and not self._effects.awaits_ears:
            self._accepted_pose_id = self.newest_pose_id
            self._has_looked = False
            # Room for other ears comes by itself; whatever else calls for an IR is told.
            self._waits_for_change = not self._effects.wants_other_ears
            return None
        newcomers = [emitter for emitter in outdated if emitter.token is None]
        if is_held and not newcomers:
            self._has_looked = True
            return None
        self._has_looked = self._has_changed = False
        is_of_a_kind = self._wanted.level == self.heard.level and not self._effects.awaits_ears
        self._is_partial = is_held and is_of_a_kind and len(newcomers) < len(outdated)
        if self._is_partial:
            outdated = newcomers
        else:
            self._next_request_clock = clock + round(self._interval_s * self._sample_rate)
        asked = {emitter.serial: as_asked(emitter) for emitter in outdated}
        for emitter in outdated:
            emitter.is_outdated = False
        self._in_flight = IrRequest(
            self.newest_pose_id,
            self._wanted.level,
            listener,
            tuple(
                EmitterSnapshot(
                    emitter.serial,
                    emitter.pose,
                    emitter.directivity,
                    self._identity(emitter, listener),
                    asked[emitter.serial],
                )
                for emitter in outdated
            ),
            self._direct_sound,
            self._effects.channels,
            is_first=bool(newcomers),
        )
        return self._in_flight

    def accept(self, response: IrResponse) -> list[ServerMessage]:
        """Put the answer of the last request into effect, with the block that follows."""
        self._in_flight = None
        self._look_again()
        if response.request.level not in {self._wanted.level, self.heard.level}:
            return []  # of a level that is no longer wanted; IRs of the one that is are out of date, all of them
        pose_id = response.request.pose_id
        asked = response.request.emitters
        arrived = {each.serial: (ir, each) for each, ir in zip(asked, response.irs, strict=True)}
        events: list[ServerMessage] = []
        if response.request.channels != self._renderer.channels:
            self._renderer.set_channels(response.request.channels)
        for identifier, emitter in self._emitters.items():
            if emitter.serial not in arrived:
                continue
            ir, snapshot = arrived[emitter.serial]
            if self._effects.accept_ir(identifier, emitter, ir, snapshot.effects, pose_id):
                emitter.identity = snapshot.identity
                events += self._announce([identifier])
        if not self._is_partial:
            self._accepted_pose_id = pose_id
        if response.request.level == self._wanted.level:
            events += self.change_rung()
        return events

    def give_up(self, request: IrRequest) -> list[ServerMessage]:
        """Nothing answers the request: what sounds goes on with the IRs it has, until a pose or an emitter changes, or
        at once where one has since."""
        self._in_flight = None
        # Others than the newcomers that it was for are still to be asked for, in their turn.
        self._has_looked |= self._is_partial and not self._has_changed
        self._waits_for_change = not (self._has_changed or self._is_partial)
        failed = {emitter.serial for emitter in request.emitters}
        for emitter in self._emitters.values():
            emitter.is_outdated |= emitter.serial in failed
        return [
            Error(code="field_failure", message=f"no impulse response could be computed for pose {request.pose_id}")
        ]

    def follow_renderer(self) -> None:
        """See, after each block, whether the IRs accepted last are heard."""
        if self.applied_pose_id != self._accepted_pose_id and self._has_applied_all():
            self.applied_pose_id = self._accepted_pose_id

    def _needs_ir(self, emitter: Emitter, listener: Pose) -> bool:
        """Whether its IR is of another pose, which where poses share responses need not make it another; or is to hold
        the direct sound, too."""
        if not (emitter.is_decided and emitter.effects.has_response):
            return False
        if emitter.is_outdated and emitter.identity is not None:
            emitter.is_outdated = not self._still_hears(emitter, listener)
        return emitter.is_outdated or emitter.wants_baking

    def _still_hears(self, emitter: Emitter, listener: Pose) -> bool:
        """Whether what is heard of an emitter is its response at the pose, too: at once where that has hardly changed
        since it was found to be."""
        found_for = emitter.identity, self._wanted.level, emitter.pose, emitter.effects, self._effects.channels
        if emitter.found_for == found_for and emitter.around is not None and emitter.around.holds(listener):
            return True
        shared = self._shared(emitter, listener)
        if shared is None or shared.identity != emitter.identity:
            return False
        emitter.found_for, emitter.around = found_for, shared.around
        return True

    def _identity(self, emitter: Emitter, listener: Pose) -> Hashable | None:
        shared = self._shared(emitter, listener)
        return shared and shared.identity

    def _shared(self, emitter: Emitter, listener: Pose) -> Shared | None:
        if emitter.effects.bakes_direct:
            return None
        field = self._levels[self._wanted.level]
        shared = shared_response(field, self._direct_sound.early_reflections, listener, emitter)
        if shared is None:
            return None
        return Shared((shared.identity, emitter.effects, self._effects.channels), shared.around)

    def _announce(self, identifiers: Iterable[str]) -> list[ServerMessage]:
        """That emitters sound from the next block on, of those of whom it has not been said."""
        events: list[ServerMessage] = []
        for identifier in identifiers:
            emitter = self._emitters[identifier]
            if not emitter.is_announced:
                emitter.is_announced = True
                events.append(EmitterAdded(id=identifier, sample_clock=self._renderer.sample_clock))
        return events

    def _has_applied_all(self) -> bool:
        return all(
            self._renderer.applied(name) == emitter.token
            for name, emitter in self._emitters.items()
            if emitter.token is not None
        )
