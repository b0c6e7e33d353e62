"""The listeners of one stream: a session each, which hear the same emitters at the same clock.

What belongs to emitters is told to every session, in the same order and between the same two blocks. So all have the
same emitters, gains and clips at every sample: a clip is read at the same place of the same memory, and a live input is
taken from its queue once for all (`server.rendering.sources.SharedSource`). Everything else is a listener's own: pose,
head, effects, responses, renderer, limiter, and the window of its unacknowledged blocks.

**When an emitter begins.** Responses come to one listener after the other. An emitter that is added while there are
several is held until each of them has its first response, and then begins for all with the same block: a short sound
would otherwise be over before the last of them hears it. A listener whose response fails is not waited for. For it, as
for one who comes later, the emitter fades in where it is by then.

An `Audience` belongs to the audio thread of its stream; `members` and `totals` may be read by any thread.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from server.core.errors import RequestError
from server.planning.plan import Plan
from server.protocol.client_messages import (
    Acknowledge,
    AddEmitter,
    AddListener,
    ClientMessage,
    ListenerPose,
    MoveEmitter,
    RemoveEmitter,
    RemoveListener,
    SetDoor,
    SetEffects,
    SetGain,
    StopEmitter,
    emitter_of,
    listener_of,
)
from server.protocol.server_messages import (
    EmitterAdded,
    EmitterEnded,
    EmitterRemoved,
    Error,
    LevelChanged,
    LevelReason,
    ListenerAdded,
    ListenerRemoved,
    PlanChanged,
    ServerMessage,
)
from server.protocol.snapshot import KeptListener, Snapshot
from server.rendering.renderer import Renderer
from server.responses.ir_request import IrRequest, IrResponse
from server.streaming.pending_work import PendingWork
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from server.streaming.stream_times import ResponseWait, StreamTimes

COST_SMOOTHING = 0.2
"""Weight of the newest of costs in their mean."""
_MOST_NUMBER = 255
"""The number of a listener has a byte in the header of blocks."""


@dataclass(frozen=True)
class NewListener:
    """A listener to add, with its session, which has rendered nothing yet, and the name of its head."""

    message: AddListener
    session: Session
    hrtf: str


@dataclass(eq=False)
class Member:
    """A listener of a stream with its session, and its turns to request impulse responses (IRs). `added` is the message
    that added it; the first has none."""

    session: Session
    added: AddListener | None = None
    times: StreamTimes = field(default_factory=StreamTimes)
    wait: ResponseWait = field(default_factory=ResponseWait)
    request_s: float = 0.0
    """The smoothed CPU time of a request for IRs; 0 before the first answer."""
    has_only_begun: bool = True
    """Whether all answers so far had first IRs of emitters, of which no part was kept: they say nothing of those that
    follow."""
    wants_turn: bool = False
    """Whether it waits for its turn to request IRs."""
    asked_last_s: float = -math.inf
    has_asked: bool = False
    is_answered: bool = False
    """Whether the answer to its request waits in the inbox. Workers set it."""
    pending: PendingWork = field(default_factory=PendingWork)
    """Its responses and plans that workers have not finished."""

    @property
    def id(self) -> str | None:
        return None if self.added is None else self.added.id

    @property
    def is_unanswered(self) -> bool:
        """Whether a request for IRs is unanswered."""
        return self.has_asked and not self.is_answered

    def note_request(self, cpu_s: float, *, is_first: bool) -> None:
        """Note the CPU time of a request for IRs, which had first IRs of emitters or not."""
        weight = 1.0 if self.has_only_begun else COST_SMOOTHING
        self.request_s += weight * (cpu_s - self.request_s)
        self.has_only_begun = self.has_only_begun and is_first

    def count(self) -> Counter[str]:
        """What has been counted of its blocks."""
        session = self.session
        return Counter(
            sent=session.window.sent,
            dropped=session.blocks_dropped,
            exchanges=session.ir_exchanges,
            limited=session.blocks_limited,
            silenced=session.renderer.samples_silenced,
        )


@dataclass(frozen=True)
class _Books:
    """The listeners, and what was counted of those who have left. Replaced at once, so that readers on other threads
    count every listener exactly once."""

    members: tuple[Member, ...]
    left: Counter[str]
    left_times: StreamTimes


@dataclass
class _Hold:
    """The listeners who have no response yet of an emitter that is held. It waits for those in `waiting`, and not for
    those who are `late`."""

    waiting: set[Member]
    late: set[Member] = field(default_factory=set)


class Audience:
    """The listeners of a stream that begins with the session of its first one."""

    def __init__(self, first: Session, times: StreamTimes) -> None:
        self.first = Member(first, times=times)
        self._books = _Books((self.first,), Counter(), StreamTimes())
        self._holds: dict[str, _Hold] = {}
        self._fading_in: list[tuple[Member, str]] = []
        """Emitters that begin later for a listener than for others, who have the gain in effect."""
        self._departed: tuple[PendingWork, ...] = ()
        """Work for listeners who have left that was being done then."""

    @property
    def members(self) -> tuple[Member, ...]:
        """The listeners, the first one first."""
        return self._books.members

    def totals(self) -> tuple[Counter[str], list[StreamTimes]]:
        """What was counted of all listeners, those who have left included, and their times."""
        books = self._books
        counts = sum((member.count() for member in books.members), Counter(books.left))
        return counts, [books.left_times, *(member.times for member in books.members)]

    @property
    def departed_work(self) -> int:
        """How many pieces of work for listeners who have left are still being done. Any thread may call this."""
        return sum(map(len, self._departed))

    @property
    def runs_by_itself(self) -> bool:
        """Whether several blocks may be rendered in one call."""
        return all(member.session.renderer.runs_by_itself for member in self.members)

    @property
    def has_no_room(self) -> bool:
        """Whether the window of every listener is full."""
        return all(member.session.window.is_full for member in self.members)

    @property
    def awaits_irs(self) -> bool:
        """Whether no listener may request IRs now. Any thread may call this."""
        return all(member.session.awaits_irs for member in self.members)

    def renderers(self, blocks: int) -> list[Renderer]:
        """The renderers of all listeners, each as often as it is to render a block."""
        return [member.session.renderer for member in self.members for _ in range(blocks)]

    def member_of(self, message: ListenerPose | Acknowledge | RemoveListener) -> Member:
        """The listener that a message is about. Raises RequestError unknown_listener."""
        identifier = message.id if isinstance(message, RemoveListener) else message.listener
        index = message.index if isinstance(message, ListenerPose) and identifier is None else None
        if identifier is None and not index:
            return self.first
        for member in self.members[1:]:
            if member.id == identifier if identifier is not None else member.session.index == index:
                return member
        name = f"there is no listener {identifier!r}" if identifier is not None else f"no listener has number {index}"
        field = "id" if isinstance(message, RemoveListener) else "index" if identifier is None else "listener"
        raise RequestError("unknown_listener", name, field=field, status=404)

    def receive(self, message: ClientMessage) -> list[ServerMessage]:
        """Process one message; if it is invalid, return an `Error` and change nothing for any listener."""
        if len(self.members) == 1 and not isinstance(message, ListenerPose | Acknowledge | RemoveListener):
            return self.collect(self.first, self._of_one(message))
        try:
            match message:
                case ListenerPose() | Acknowledge():
                    member = self.member_of(message)
                    return self.collect(member, member.session.receive(message))
                case RemoveListener():
                    return self._remove(self.member_of(message))
                case MoveEmitter():
                    self._require_newest(message)
                case AddEmitter():
                    return self._add_emitter(message)
        except RequestError as refusal:
            return [Error.from_refusal(refusal, emitter_of(message), listener_of(message))]
        events = self.collect(self.first, self._of_one(message))
        if any(isinstance(event, Error) for event in events):
            return events
        if isinstance(message, MoveEmitter | RemoveEmitter | SetGain | StopEmitter | SetEffects | SetDoor):
            for member in self.members[1:]:
                events += self.collect(member, member.session.receive(message))
        return events

    def _of_one(self, message: ClientMessage) -> list[ServerMessage]:
        events = self.first.session.receive(message)
        if isinstance(message, RemoveEmitter):
            self._holds.pop(message.id, None)
        return events

    def _require_newest(self, message: MoveEmitter) -> None:
        """Raises RequestError stale_pose, before any listener has taken the move."""
        newest = max(member.session.newest_pose_id for member in self.members)
        # guard: an old pose is refused for all listeners
        if message.id in self.first.session.emitters and message.pose_id <= newest:
            problem = f"pose {message.pose_id} is not newer than {newest}"
            raise RequestError("stale_pose", problem, field="pose_id")

    def _add_emitter(self, message: AddEmitter) -> list[ServerMessage]:
        first = self.first.session
        events = first.receive(message)
        if any(isinstance(event, Error) for event in events):
            return events
        shared: list[Session] = [first]
        try:
            for member in self.members[1:]:
                member.session.share_emitter(message.id, first)
                shared.append(member.session)
        except RequestError:
            # guard: an emitter is there for all listeners or for none
            for session in shared:
                session.forget_emitter(message.id)
            raise
        self._hold(message.id, self.members)
        return self.collect(self.first, events)

    def _hold(self, identifier: str, members: Sequence[Member]) -> None:
        """Let an emitter begin for nobody until these listeners have a response."""
        hold = self._holds.setdefault(identifier, _Hold(set()))
        hold.waiting.update(members)
        for member in members:
            member.session.renderer.hold(identifier)

    def join(self, new: NewListener, quality: QualityStep, *, sequence: int = 0) -> ListenerAdded:
        """Add a listener from the next block on, at the quality of the others. Its first block has this `sequence`."""
        first, session = self.first.session, new.session
        held = [name for name, emitter in first.emitters.items() if emitter.since is None]
        session.join(first, quality, sequence)
        member = Member(session, new.message)
        for name in held:
            self._hold(name, [member] if name in self._holds else [*self.members, member])
        self._fading_in += [(member, name) for name in session.emitters if name not in self._holds]
        books = self._books
        self._books = _Books((*books.members, member), books.left, books.left_times)
        clock = session.sample_clock
        return ListenerAdded(id=new.message.id, index=session.index, hrtf=new.hrtf, sample_clock=clock)

    def _remove(self, member: Member) -> list[ServerMessage]:
        member.pending.cancel()
        self._departed = tuple(pending for pending in (*self._departed, member.pending) if pending)
        books = self._books
        times = StreamTimes()
        times.merge(books.left_times)
        times.merge(member.times)
        members = tuple(other for other in books.members if other is not member)
        self._books = _Books(members, books.left + member.count(), times)
        self._fading_in = [each for each in self._fading_in if each[0] is not member]
        begun: list[ServerMessage] = []
        for name, hold in tuple(self._holds.items()):
            hold.waiting.discard(member)
            hold.late.discard(member)
            begun += self._begin_if_ready(name)
        assert member.id is not None
        return [ListenerRemoved(id=member.id, index=member.session.index), *begun]

    def collect(self, member: Member, events: Sequence[ServerMessage]) -> list[ServerMessage]:
        """What the client is told of the events of one listener: who hears them and, of what is common to all, once."""
        told: list[ServerMessage] = []
        for event in events:
            match event:
                case EmitterAdded() if event.id in self._holds:
                    hold = self._holds[event.id]
                    hold.waiting.discard(member)
                    hold.late.discard(member)
                    told += self._begin_if_ready(event.id)
                case EmitterAdded() | EmitterEnded() | EmitterRemoved() if member is not self.first:
                    pass  # the first one has told it
                case LevelChanged() | PlanChanged() | Error() if member is not self.first:
                    told.append(event.model_copy(update={"listener": member.id}))
                case _:
                    told.append(event)
        for name in self._holds:  # it has begun for nobody, whatever responses there are
            for each in self.members:
                each.session.emitters[name].since = None
        return told

    def _begin_if_ready(self, identifier: str) -> list[ServerMessage]:
        """Let an emitter that is held begin with the next block, if nobody is waited for."""
        hold = self._holds[identifier]
        if hold.waiting or len(hold.late) == len(self.members):
            return []
        del self._holds[identifier]
        clock = self.first.session.sample_clock
        for member in self.members:
            is_late = member in hold.late
            member.session.renderer.release(identifier, since=clock if is_late else None)
            member.session.emitters[identifier].since = clock
            if is_late:
                self._fading_in.append((member, identifier))
        starts_at = self.first.session.emitters[identifier].starts_at
        return [EmitterAdded(id=identifier, sample_clock=max(clock, starts_at))]

    def accept(self, member: Member, response: IrResponse) -> list[ServerMessage]:
        """Put the answer to a listener's last request into effect, from the next block on."""
        return self.collect(member, member.session.accept(response))

    def give_up(self, member: Member, request: IrRequest) -> list[ServerMessage]:
        """Note that a listener's request failed. Emitters that are held do not wait for it any longer."""
        events = self.collect(member, member.session.give_up(request))
        failed = {asked.serial for asked in request.asked}
        for name, hold in tuple(self._holds.items()):
            if member in hold.waiting and member.session.emitters[name].serial in failed:
                hold.waiting.discard(member)
                hold.late.add(member)
                events += self._begin_if_ready(name)
        return events

    def adopt(self, member: Member, plan: Plan) -> list[ServerMessage]:
        """Put the plan that a listener requested last into effect, from the next block on."""
        return self.collect(member, member.session.adopt(plan))

    def keep_effects(self, member: Member) -> list[ServerMessage]:
        """Note that a listener's request for a plan failed."""
        return self.collect(member, member.session.keep_effects())

    def set_quality(self, quality: QualityStep, reason: LevelReason) -> list[ServerMessage]:
        """Change all listeners to another quality step."""
        told: list[ServerMessage] = []
        for member in self.members:
            told += self.collect(member, member.session.set_quality(quality, reason))
        return told

    def begin_block(self) -> None:
        """Set the direct paths of the next block from the newest poses."""
        if self._fading_in:
            self._follow_gains()
        for member in self.members:
            member.session.begin_block()

    def _follow_gains(self) -> None:
        """Keep the gains of emitters that have not begun for a listener as they are for the others."""
        still = []
        for member, name in self._fading_in:
            emitters = member.session.emitters
            if name not in emitters or member.session.renderer.has_begun(name):
                continue
            still.append((member, name))
            played = next(
                (
                    other.session.renderer
                    for other in self.members
                    if other is not member and other.session.renderer.has_begun(name)
                ),
                None,
            )
            if played is not None:
                member.session.renderer.take_gain(name, played)
        self._fading_in = still

    def follow_clock(self) -> list[ServerMessage]:
        """Note what has come to its end by the next block: an emitter's clip ends when all listeners have heard it for
        whom it has begun. One whose response fails keeps no sound alive."""
        if len(self.members) == 1:
            return self.first.session.follow_clock()
        told: list[ServerMessage] = []
        for member in self.members:
            member.session.follow_ramps()
        for name in tuple(self.first.session.emitters):
            still = [member.session for member in self.members if not member.session.has_ended(name)]
            if len(still) < len(self.members) and not any(session.renderer.has_begun(name) for session in still):
                for member in self.members:
                    told += self.collect(member, member.session.end_emitter(name))
        return told

    def snapshot(self, *, session: str, handled: int) -> Snapshot:
        """Return the state before the next block. Not validated, since this runs on the audio thread."""
        snapshot = self.first.session.snapshot(session=session, handled=handled)
        others = self.members[1:]
        if not others:
            return snapshot
        return snapshot.model_copy(
            update={
                "hello": snapshot.hello.model_copy(update={"listeners": len(self.members)}),
                "pose_id": max(member.session.newest_pose_id for member in self.members),
                "sequence": max(member.session.window.next_sequence for member in self.members),
                "listeners": tuple(_kept(member) for member in others),
            }
        )


def _kept(member: Member) -> KeptListener:
    assert member.added is not None
    pose = member.session.listener
    now = {"position": pose.position, "orientation": pose.orientation, "yaw": None}
    given = {name: getattr(member.added, name) for name in AddListener.model_fields}
    listener = AddListener.model_construct(**{**given, **now})
    return KeptListener.model_construct(listener=listener, index=member.session.index)


class Roster:
    """The ids and numbers of a stream's listeners beside the first, at most `most` - 1 of them, as the client has asked
    for them. A number is used again only after all others, so that no block of a listener who has left is taken for one
    of a newcomer. It belongs to the event loop."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._numbers: dict[str, int] = {}
        self._last = 0

    def __len__(self) -> int:
        return 1 + len(self._numbers)

    def enter(self, identifier: str, number: int | None = None) -> int:
        """Enter a listener and return its number, the next one unless it is given. Raises RequestError
        duplicate_listener and too_many_listeners."""
        # guard: two listeners have not one id
        if identifier in self._numbers:
            raise RequestError("duplicate_listener", f"listener {identifier!r} is already there", field="id")
        # guard: a stream has room for so many listeners
        if len(self) >= self._most:
            raise RequestError("too_many_listeners", f"a stream has at most {self._most} listeners")
        taken = set(self._numbers.values())
        if number is None:
            following = (1 + (self._last + step) % _MOST_NUMBER for step in range(_MOST_NUMBER))
            number = next(each for each in following if each not in taken)
        self._numbers[identifier] = self._last = number
        return number

    def leave(self, identifier: str) -> None:
        """Strike a listener out. Raises RequestError unknown_listener."""
        if identifier not in self._numbers:
            raise RequestError("unknown_listener", f"there is no listener {identifier!r}", field="id", status=404)
        del self._numbers[identifier]
