"""Requests the impulse responses (IRs) for a session's newest poses at the quality chosen last, and gives them to the
renderer.

IRs are computed off the audio thread: `take_request` returns the ones to compute, one request at a time and always for
the newest poses. They come back through `accept`, or through `give_up` if the computation failed. A quality step with
another level takes effect when its IRs have arrived. Clocks are in samples.
"""

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, auto

from server.acoustics.doors import Openness
from server.acoustics.geometry import Pose
from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.server_messages import EmitterAdded, Error, LevelChanged, LevelReason, ServerMessage
from server.rendering.convolver import PartitionedIr, Sharing
from server.rendering.renderer import Renderer
from server.responses.direct_sound import DirectSound
from server.responses.emitter_state import EmitterState
from server.responses.ir_cache import Shared, shared_response
from server.responses.ir_request import AskedIr, IrRequest, IrResponse
from server.streaming.active_effects import ActiveEffects
from server.streaming.emitters import StreamedEmitter, Validity, WholeResponse
from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.quality_steps import QualityStep


class Scope(Enum):
    """Which IRs may be requested."""

    ALL = auto()
    """The IRs of all emitters whose IR is out of date."""
    FIRST = auto()
    """Only the first IRs of emitters that are not audible yet."""


class _Demand(Enum):
    """Whether there are IRs to request next."""

    UNKNOWN = auto()
    """Something has changed, so the emitters have to be checked."""
    LATER = auto()
    """There are some, but it is too soon to request them."""
    NONE = auto()
    """There are none until something changes."""


@dataclass
class _InFlight:
    """The unanswered request. It `is_partial` if it leaves out other IRs that are out of date, and `is_overtaken` if a
    change since then may call for another request."""

    request: IrRequest
    is_partial: bool
    is_overtaken: bool = False


class ResponseScheduler:
    """The scheduler of one session with its audible `emitters`. `quality` is the first quality, one of `levels`."""

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
        """The quality that is playing."""
        self.newest_pose_id = 0
        self.applied_pose_id = 0
        """The id of the poses whose IRs are playing."""
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
        effects.bus = levels[quality.level].level.bus
        renderer.share(quality.sharing)

    @property
    def are_awaited(self) -> bool:
        """Whether a request is unanswered, or it is too soon for the next. Any thread may call this."""
        return self._in_flight is not None or self._renderer.sample_clock < self._next_request_clock

    @property
    def are_wanted(self) -> bool:
        """Whether the last check found IRs to request, and it is time to request them."""
        return self._demand is _Demand.LATER and not self.are_awaited

    @property
    def levels(self) -> FieldsByLevel:
        """The levels by which responses are computed."""
        return self._levels

    def hear_by(self, direct_sound: DirectSound, levels: FieldsByLevel) -> None:
        """Ask for all responses anew, by another direct sound and by the same levels of other surroundings."""
        self._direct_sound, self._levels = direct_sound, levels
        for emitter in self._emitters.values():
            emitter.is_outdated = True
        self._look_again()

    def set_quality(self, quality: QualityStep, reason: LevelReason) -> list[ServerMessage]:
        """Change to another quality step: from now on, or for another level when its IRs have arrived."""
        if quality.level != self._wanted.level:
            for emitter in self._emitters.values():
                emitter.is_outdated = True
            self._look_again()
            self._next_request_clock = 0
        if quality.late_reach_m < self._wanted.late_reach_m:
            for emitter in self._emitters.values():
                emitter.is_outdated |= emitter.heard.keeps_late
            self._look_again()
        self._wanted, self._reason = quality, reason
        self._effects.bus = self._levels[quality.level].level.bus
        self._share()
        return self.change_quality() if quality.level == self.heard.level else self.change_quality_unheard()

    def _share(self) -> None:
        """Have emitters share what the heard step shares. Where load calls for another step, they share at once what
        that one does, whatever its level: its IRs may be long in coming on a server that has too much to do, and shared
        ones take less time to render."""
        at_once = self._wanted.sharing if self._reason == "load" else Sharing.NOTHING
        self._effects.share(max(self.heard.sharing, at_once), self._emitters)

    def change_quality_unheard(self) -> list[ServerMessage]:
        """Change to the step chosen last if no emitter has, or will have, an IR that differs between levels."""
        has_irs = any(not emitter.is_decided or emitter.effects.has_response for emitter in self._emitters.values())
        return [] if has_irs else self.change_quality()

    def change_quality(self) -> list[ServerMessage]:
        """Change to the step chosen last, from the next block on."""
        if self._wanted == self.heard:
            return []
        self.heard = self._wanted
        self._share()
        return [
            LevelChanged(
                level=self.heard.level,
                reason=self._reason,
                ir_rate_hz=self.heard.ir_rate_hz,
                shared_tail=self.heard.sharing is not Sharing.NOTHING,
                sample_clock=self._renderer.sample_clock,
            )
        ]

    def space(self, interval_s: float) -> None:
        """Set the least time between requests; an emitter that waits for its first IR is not affected."""
        self._interval_s = interval_s

    def continue_from(self, pose_id: int) -> None:
        """Begin with this pose as the newest one, before any other."""
        self.newest_pose_id = self.applied_pose_id = self._accepted_pose_id = pose_id

    def advance(self, pose_id: int) -> None:
        """Note a new pose of the listener or of an emitter. Raises RequestError if a newer one came before."""
        # guard: an old pose is refused
        if pose_id <= self.newest_pose_id:
            raise RequestError("stale_pose", f"pose {pose_id} is not newer than {self.newest_pose_id}", field="pose_id")
        self.newest_pose_id = pose_id
        if self._demand is _Demand.LATER and not self._levels[self._wanted.level].kind.reuses_responses:
            self._note_change()
        else:
            self._look_again()  # the response that is playing may fit this pose again

    def retry(self) -> None:
        """Check for IRs to request, after an emitter was added or a plan decided about one."""
        self._look_again()

    def _look_again(self) -> None:
        """Note a change that may call for an IR."""
        self._demand = _Demand.UNKNOWN
        self._note_change()

    def _note_change(self) -> None:
        if self._in_flight is not None:
            self._in_flight.is_overtaken = True

    def enforce_plan(self) -> list[ServerMessage]:
        """Put the plan of effects into effect, from the next block on."""
        events = self._announce(self._effects.enforce(self._emitters))
        self._share()
        self._look_again()
        return events + self.change_quality_unheard()

    def take_request(self, listener: Pose, scope: Scope = Scope.ALL) -> IrRequest | None:
        """Return the IRs to compute now; None while a request is unanswered, if every IR is up to date, or if none is
        in `scope`. If it is too soon for others, only first IRs are requested."""
        if self._in_flight is not None or self._demand is _Demand.NONE:
            return None
        if self._renderer.sample_clock < self._next_request_clock:
            scope = Scope.FIRST
        if scope is Scope.FIRST and self._demand is _Demand.LATER:
            return None
        outdated = [emitter for emitter in self._emitters.values() if self._needs_ir(emitter, listener)]
        if not outdated and not self._effects.awaits_ears:
            self._accepted_pose_id = self.newest_pose_id
            # The renderer does not report room for other channels; every other cause for an IR is reported.
            self._demand = _Demand.UNKNOWN if self._effects.wants_other_ears else _Demand.NONE
            return None
        first = [emitter for emitter in outdated if emitter.heard.token is None]
        if scope is Scope.FIRST and not first:
            self._demand = _Demand.LATER
            return None
        # IRs of another level, or with other channels, replace all at once.
        replaces_all = self._wanted.level != self.heard.level or self._effects.awaits_ears
        is_partial = scope is Scope.FIRST and not replaces_all and len(first) < len(outdated)
        if not is_partial:
            self._next_request_clock = self._renderer.sample_clock + round(self._interval_s * self._sample_rate)
        self._demand = _Demand.UNKNOWN
        request = self._request(listener, first if is_partial else outdated, is_first=bool(first))
        self._in_flight = _InFlight(request, is_partial)
        return request

    def _request(self, listener: Pose, emitters: list[StreamedEmitter], *, is_first: bool) -> IrRequest:
        states = [self._effects.as_asked(emitter) for emitter in emitters]
        kept = self._kept(emitters, states, listener)
        for emitter in emitters:
            emitter.is_outdated = False
        asked = tuple(
            AskedIr(emitter.serial, state, self._identity(emitter, listener), kept.get(emitter.serial))
            for emitter, state in zip(emitters, states, strict=True)
        )
        return IrRequest(
            self.newest_pose_id,
            self._wanted.level,
            listener,
            asked,
            self._direct_sound,
            self._effects.channels,
            self._levels.bundle.openness,
            is_first=is_first,
        )

    def _kept(
        self, emitters: Iterable[StreamedEmitter], states: Iterable[EmitterState], listener: Pose
    ) -> dict[int, PartitionedIr]:
        """The IRs, by serial, whose later parts the next ones keep. Of those that have become too old, a few are left
        out at a time, the oldest first: if a request were to compute all of them anew, it would take so long that the
        next had to do so, too."""
        reach_m, kind = self._wanted.late_reach_m, self._levels[self._wanted.level].kind
        if reach_m == 0 or kind.reuses_responses:
            return {}
        ages: dict[int, float] = {}
        kept = {}
        for emitter, state in zip(emitters, states, strict=True):
            whole = emitter.heard.whole
            openness = self._levels.bundle.openness
            circumstances = self._circumstances(self._wanted.level, state, self._effects.channels, openness)
            if whole is not None and whole.circumstances == circumstances and not state.effects.bakes_direct:
                kept[emitter.serial] = whole.ir
                ages[emitter.serial] = whole.age(listener, state.position, reach_m, THRESHOLDS.late_turn_deg)
        oldest = sorted((serial for serial, age in ages.items() if age > 1), key=ages.__getitem__, reverse=True)
        for serial in oldest[: THRESHOLDS.whole_at_once]:
            del kept[serial]
        return kept

    @staticmethod
    def _circumstances(level: str, state: EmitterState, channels: int, openness: Openness) -> Hashable:
        """On what else but poses the later part of an IR depends."""
        return level, state.effects.early, state.effects.late, state.directivity, channels, openness

    def accept(self, response: IrResponse) -> list[ServerMessage]:
        """Put the answer to the last request into effect, from the next block on."""
        is_partial = self._in_flight is not None and self._in_flight.is_partial
        self._in_flight = None
        self._look_again()
        if response.request.level not in {self._wanted.level, self.heard.level}:
            return []  # its level is no longer wanted, and all IRs of the wanted level are still to be requested
        pose_id = response.request.pose_id
        arrived = {each.serial: (ir, each) for each, ir in zip(response.request.asked, response.irs, strict=True)}
        events: list[ServerMessage] = []
        if response.request.channels != self._renderer.channels:
            self._renderer.set_channels(response.request.channels)
        for identifier, emitter in self._emitters.items():
            if emitter.serial not in arrived:
                continue
            ir, asked = arrived[emitter.serial]
            if asked.like is None:
                request = response.request
                circumstances = self._circumstances(request.level, asked.state, request.channels, request.openness)
                where = response.request.listener, asked.state.position
                emitter.heard.whole = WholeResponse(ir, *where, circumstances)
            if self._effects.accept_ir(identifier, emitter, ir, asked.state.effects, pose_id):
                emitter.heard.identity, emitter.heard.keeps_late = asked.identity, asked.like is not None
                events += self._announce([identifier])
        if not is_partial:
            self._accepted_pose_id = pose_id
        if response.request.level == self._wanted.level:
            events += self.change_quality()
        return events

    def give_up(self, request: IrRequest) -> list[ServerMessage]:
        """Note that a request failed: playing IRs stay in use until a pose or an emitter changes, or until the next
        request if one has changed since."""
        failing, self._in_flight = self._in_flight, None
        if failing is not None and not failing.is_overtaken:
            # The IRs that a partial request left out are still to be requested, in their turn.
            self._demand = _Demand.LATER if failing.is_partial else _Demand.NONE
        failed = {asked.serial for asked in request.asked}
        for emitter in self._emitters.values():
            emitter.is_outdated |= emitter.serial in failed
        return [
            Error(code="field_failure", message=f"no impulse response could be computed for pose {request.pose_id}")
        ]

    def follow_renderer(self) -> None:
        """Check, after each block, whether the IRs accepted last are playing."""
        if self.applied_pose_id != self._accepted_pose_id and self._has_applied_all():
            self.applied_pose_id = self._accepted_pose_id

    def _needs_ir(self, emitter: StreamedEmitter, listener: Pose) -> bool:
        """Return whether an emitter needs an IR: its IR belongs to another pose that does not share the response, or is
        to include the direct sound."""
        if not (emitter.is_decided and emitter.effects.has_response):
            return False
        if emitter.is_outdated and emitter.heard.identity is not None:
            emitter.is_outdated = not self._still_hears(emitter, listener)
        return emitter.is_outdated or self._effects.wants_baking(emitter)

    def _still_hears(self, emitter: StreamedEmitter, listener: Pose) -> bool:
        """Return whether the IR that is playing for an emitter is also its response at this pose. This is fast while
        the listener stays near the pose for which it was last confirmed."""
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
        if self._effects.bakes(emitter):
            return None
        field = self._levels[self._wanted.level]
        shared = shared_response(field, self._direct_sound.early_reflections, listener, emitter.state)
        if shared is None:
            return None
        return Shared((shared.identity, emitter.effects, self._effects.channels), shared.around)

    def _announce(self, identifiers: Iterable[str]) -> list[ServerMessage]:
        """Return messages that these emitters are audible from the next block on, for those not announced before."""
        clock = self._renderer.sample_clock
        news = [identifier for identifier in identifiers if self._emitters[identifier].announce(clock)]
        return [
            EmitterAdded(id=identifier, sample_clock=max(clock, self._emitters[identifier].starts_at))
            for identifier in news
        ]

    def _has_applied_all(self) -> bool:
        return all(
            self._renderer.applied(name) == emitter.heard.token
            for name, emitter in self._emitters.items()
            if emitter.heard.token is not None
        )
