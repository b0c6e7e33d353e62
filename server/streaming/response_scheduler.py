"""Has a renderer make what follows a session's direct sound: the impulse responses (IRs) of its newest poses, at the
quality that was asked for last.

IRs are computed off the audio thread: `take_request` says which, one request at a time and always for the newest poses,
and they come back through `accept`, or through `give_up` where none could be. A step that takes another level's
IRs is heard from when they are there. Clocks are samples.
"""

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, auto

from server.acoustics.geometry import Pose
from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.server_messages import EmitterAdded, Error, LevelChanged, LevelReason, ServerMessage
from server.rendering.renderer import Renderer
from server.responses.direct_sound import DirectSound
from server.responses.ir_cache import Shared, shared_response
from server.responses.ir_request import AskedIr, IrRequest, IrResponse
from server.streaming.active_effects import ActiveEffects, as_asked
from server.streaming.emitters import StreamedEmitter, Validity
from server.streaming.quality_steps import QualityStep


class Scope(Enum):
    """Which IRs may be asked for."""

    ALL = auto()
    """Those of all emitters whose IR is out of date."""
    FIRST = auto()
    """First ones alone, of emitters that are not heard yet."""


class _Demand(Enum):
    """What is known of the IRs to ask for next."""

    UNKNOWN = auto()
    """Something has changed: it is to be looked at."""
    LATER = auto()
    """There are some, which wait for their time."""
    NONE = auto()
    """There are none until something changes."""


@dataclass
class _InFlight:
    """The request that is unanswered. It `is_partial` where other IRs than those it asks for are out of date too, and
    `is_overtaken` where something has changed since that may call for another."""

    request: IrRequest
    is_partial: bool
    is_overtaken: bool = False


class ResponseScheduler:
    """Of one session, whose `emitters` are who sounds at each moment. `quality` is what is heard of `levels` first."""

    def __init__(
        self,
        renderer: Renderer,
        effects: ActiveEffects,
        emitters: Mapping[str, StreamedEmitter],
        *,
        levels: FieldsByLevel,
        direct_sound: DirectSound,
        quality: QualityStep,
    ) -> None:
        self.heard = quality
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
        self._wanted = quality
        self._reason: LevelReason = "chosen"
        self._accepted_pose_id = 0
        self._in_flight: _InFlight | None = None
        self._demand = _Demand.UNKNOWN
        self._interval_s = 0.0
        self._next_request_clock = 0
        renderer.share_tail(quality.shared_tail)

    @property
    def are_awaited(self) -> bool:
        """Whether a request is unanswered, or it is too soon for the next; may be asked from any thread."""
        return self._in_flight is not None or self._renderer.sample_clock < self._next_request_clock

    @property
    def are_wanted(self) -> bool:
        """Whether there was something to ask for when it was looked last, and it is time to."""
        return self._demand is _Demand.LATER and not self.are_awaited

    def set_quality(self, quality: QualityStep, reason: LevelReason) -> list[ServerMessage]:
        """Have IRs come from another step: from now on, or, where it takes another level's, from when they are
        there."""
        if quality.level != self._wanted.level:
            for emitter in self._emitters.values():
                emitter.is_outdated = True
            self._look_again()
            self._next_request_clock = 0
        self._wanted, self._reason = quality, reason
        return self.change_quality() if quality.level == self.heard.level else self.change_quality_unheard()

    def change_quality_unheard(self) -> list[ServerMessage]:
        """Stand on the step that was asked for last where no emitter has, or is to have, an IR that tells levels
        apart."""
        has_irs = any(not emitter.is_decided or emitter.effects.has_response for emitter in self._emitters.values())
        return [] if has_irs else self.change_quality()

    def change_quality(self) -> list[ServerMessage]:
        """Stand on the step that was asked for last, with the block that follows."""
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
        # guard: an old pose is refused
        if pose_id <= self.newest_pose_id:
            raise RequestError("stale_pose", f"pose {pose_id} is not newer than {self.newest_pose_id}", field="pose_id")
        self.newest_pose_id = pose_id
        if self._demand is _Demand.LATER and not self._levels[self._wanted.level].kind.reuses_responses:
            self._note_change()
        else:
            self._look_again()  # what is heard may be the pose's response again

    def retry(self) -> None:
        """Look again at what to ask for: somebody has come, or is decided about."""
        self._look_again()

    def _look_again(self) -> None:
        """Something has changed that may call for an IR."""
        self._demand = _Demand.UNKNOWN
        self._note_change()

    def _note_change(self) -> None:
        if self._in_flight is not None:
            self._in_flight.is_overtaken = True

    def enforce_plan(self) -> list[ServerMessage]:
        """Put the plan of effects into effect, with the block that follows."""
        events = self._announce(self._effects.enforce(self._emitters))
        self._effects.share_tail(self.heard.shared_tail, self._emitters)
        self._look_again()
        return events + self.change_quality_unheard()

    def take_request(self, listener: Pose, scope: Scope = Scope.ALL) -> IrRequest | None:
        """The IRs to compute now. None while an earlier request is unanswered, when every IR is up to date, or where
        none is in `scope`. Where it is not time for others, first ones are asked for alone."""
        if self._in_flight is not None or self._demand is _Demand.NONE:
            return None
        if self._renderer.sample_clock < self._next_request_clock:
            scope = Scope.FIRST
        if scope is Scope.FIRST and self._demand is _Demand.LATER:
            return None
        outdated = [emitter for emitter in self._emitters.values() if self._needs_ir(emitter, listener)]
        if not outdated and not self._effects.awaits_ears:
            self._accepted_pose_id = self.newest_pose_id
            # Room for other ears comes by itself; whatever else calls for an IR is told.
            self._demand = _Demand.UNKNOWN if self._effects.wants_other_ears else _Demand.NONE
            return None
        first = [emitter for emitter in outdated if emitter.heard.token is None]
        if scope is Scope.FIRST and not first:
            self._demand = _Demand.LATER
            return None
        # IRs of another level, or for other ears, replace all at once.
        replaces_all = self._wanted.level != self.heard.level or self._effects.awaits_ears
        is_partial = scope is Scope.FIRST and not replaces_all and len(first) < len(outdated)
        if not is_partial:
            self._next_request_clock = self._renderer.sample_clock + round(self._interval_s * self._sample_rate)
        self._demand = _Demand.UNKNOWN
        request = self._request(listener, first if is_partial else outdated, is_first=bool(first))
        self._in_flight = _InFlight(request, is_partial)
        return request

    def _request(self, listener: Pose, emitters: list[StreamedEmitter], *, is_first: bool) -> IrRequest:
        states = [as_asked(emitter) for emitter in emitters]
        for emitter in emitters:
            emitter.is_outdated = False
        asked = tuple(
            AskedIr(emitter.serial, state, self._identity(emitter, listener))
            for emitter, state in zip(emitters, states, strict=True)
        )
        return IrRequest(
            self.newest_pose_id,
            self._wanted.level,
            listener,
            asked,
            self._direct_sound,
            self._effects.channels,
            is_first=is_first,
        )

    def accept(self, response: IrResponse) -> list[ServerMessage]:
        """Put the answer of the last request into effect, with the block that follows."""
        is_partial = self._in_flight is not None and self._in_flight.is_partial
        self._in_flight = None
        self._look_again()
        if response.request.level not in {self._wanted.level, self.heard.level}:
            return []  # of a level that is no longer wanted; IRs of the one that is are out of date, all of them
        pose_id = response.request.pose_id
        arrived = {each.serial: (ir, each) for each, ir in zip(response.request.asked, response.irs, strict=True)}
        events: list[ServerMessage] = []
        if response.request.channels != self._renderer.channels:
            self._renderer.set_channels(response.request.channels)
        for identifier, emitter in self._emitters.items():
            if emitter.serial not in arrived:
                continue
            ir, asked = arrived[emitter.serial]
            if self._effects.accept_ir(identifier, emitter, ir, asked.state.effects, pose_id):
                emitter.heard.identity = asked.identity
                events += self._announce([identifier])
        if not is_partial:
            self._accepted_pose_id = pose_id
        if response.request.level == self._wanted.level:
            events += self.change_quality()
        return events

    def give_up(self, request: IrRequest) -> list[ServerMessage]:
        """Nothing answers the request: what sounds goes on with the IRs it has, until a pose or an emitter changes, or
        at once where one has since."""
        failing, self._in_flight = self._in_flight, None
        if failing is not None and not failing.is_overtaken:
            # Others than the first ones that it was for are still to be asked for, in their turn.
            self._demand = _Demand.LATER if failing.is_partial else _Demand.NONE
        failed = {asked.serial for asked in request.asked}
        for emitter in self._emitters.values():
            emitter.is_outdated |= emitter.serial in failed
        return [
            Error(code="field_failure", message=f"no impulse response could be computed for pose {request.pose_id}")
        ]

    def follow_renderer(self) -> None:
        """See, after each block, whether the IRs accepted last are heard."""
        if self.applied_pose_id != self._accepted_pose_id and self._has_applied_all():
            self.applied_pose_id = self._accepted_pose_id

    def _needs_ir(self, emitter: StreamedEmitter, listener: Pose) -> bool:
        """Whether its IR is of another pose, which where poses share responses need not make it another; or is to hold
        the direct sound, too."""
        if not (emitter.is_decided and emitter.effects.has_response):
            return False
        if emitter.is_outdated and emitter.heard.identity is not None:
            emitter.is_outdated = not self._still_hears(emitter, listener)
        return emitter.is_outdated or emitter.wants_baking

    def _still_hears(self, emitter: StreamedEmitter, listener: Pose) -> bool:
        """Whether what is heard of an emitter is its response at the pose, too: at once where that has hardly changed
        since it was found to be."""
        heard = emitter.heard
        circumstances = heard.identity, self._wanted.level, emitter.state, self._effects.channels
        if heard.validity is not None and heard.validity.holds(circumstances, listener):
            return True
        shared = self._shared(emitter, listener)
        if shared is None or shared.identity != heard.identity:
            return False
        heard.validity = Validity(circumstances, shared.around)
        return True

    def _identity(self, emitter: StreamedEmitter, listener: Pose) -> Hashable | None:
        shared = self._shared(emitter, listener)
        return shared and shared.identity

    def _shared(self, emitter: StreamedEmitter, listener: Pose) -> Shared | None:
        if emitter.effects.bakes_direct:
            return None
        field = self._levels[self._wanted.level]
        shared = shared_response(field, self._direct_sound.early_reflections, listener, emitter.state)
        if shared is None:
            return None
        return Shared((shared.identity, emitter.effects, self._effects.channels), shared.around)

    def _announce(self, identifiers: Iterable[str]) -> list[ServerMessage]:
        """That emitters sound from the next block on, of those of whom it has not been said."""
        clock = self._renderer.sample_clock
        news = [identifier for identifier in identifiers if self._emitters[identifier].announce()]
        return [EmitterAdded(id=identifier, sample_clock=clock) for identifier in news]

    def _has_applied_all(self) -> bool:
        return all(
            self._renderer.applied(name) == emitter.heard.token
            for name, emitter in self._emitters.items()
            if emitter.heard.token is not None
        )
