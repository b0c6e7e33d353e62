"""Queues of items for an audio thread: a client's messages, and results from workers.

The event loop and the workers put items in, and the audio thread takes them out, all without locks.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from server.planning.plan import Plan
from server.protocol.client_messages import MOST_LISTENERS, AddEmitter, ClientMessage, ListenerPose, RemoveListener
from server.responses.ir_request import IrRequest, IrResponse
from server.streaming.audience import Member, NewListener
from server.streaming.doors import DoorRequest, DoorsMoved
from server.streaming.plan_audit import Regret
from server.streaming.quality_steps import QualityStep

MAX_WAITING_MESSAGES = 256


@dataclass(frozen=True)
class ChosenSteps:
    """A client's choice of a quality level: its name, its steps, and the number of the one to begin on."""

    level: str
    steps: tuple[QualityStep, ...]
    at: int


@dataclass(frozen=True)
class TakeSnapshot:
    """Asks for the state of a stream after all earlier messages, of which `handled` count (`Snapshot.handled`)."""

    session: str
    handled: int


_NEVER_REFUSED = TakeSnapshot | RemoveListener
"""What the server has noted already, or asks for itself."""
StreamMessage = ClientMessage | ChosenSteps | TakeSnapshot | NewListener


@dataclass(frozen=True)
class ComputedResponse:
    response: IrResponse
    duration_s: float
    cpu_s: float
    """CPU time of the thread that computed the response."""


class Inbox:
    """The queues of one stream. An exception in place of a result means that the work failed."""

    def __init__(self) -> None:
        self.responses: deque[tuple[Member, IrRequest, ComputedResponse | BaseException]] = deque()
        """Responses, each with the listener for whom it was requested."""
        self.plans: deque[tuple[Member, tuple[Plan, float] | BaseException]] = deque()
        """Plans, each with the listener for whom it was made and the CPU time that it took."""
        self.doors: deque[tuple[Member, DoorRequest, DoorsMoved | BaseException]] = deque()
        """States of doors, each with the listener for whom it was requested."""
        self.regrets: deque[tuple[Member, Regret | BaseException]] = deque()
        self.brings_emitter = False
        """Whether a waiting message adds an emitter, or a listener who hears those there are."""
        self.asks_for_state = False
        """Whether a waiting message asks for the stream's state."""
        self._messages: deque[tuple[float, StreamMessage]] = deque()

    def put_message(self, message: StreamMessage, now_s: float) -> bool:
        """Queue a message; return False, and refuse it, if too many of the client's are waiting. A listener's pose
        replaces an older one of the same listener before it if only poses of listeners lie between, and counts from
        when that one arrived: the listener has waited since then."""
        if not self._replace_pose(message):
            if len(self._messages) >= MAX_WAITING_MESSAGES and not isinstance(message, _NEVER_REFUSED):
                return False
            self._messages.append((now_s, message))
        self.brings_emitter |= isinstance(message, AddEmitter | NewListener)
        self.asks_for_state |= isinstance(message, TakeSnapshot)
        return True

    def _replace_pose(self, message: StreamMessage) -> bool:
        if not isinstance(message, ListenerPose):
            return False
        try:
            for place in range(-1, -1 - MOST_LISTENERS, -1):
                arrived_s, last = self._messages[place]
                if not isinstance(last, ListenerPose):
                    return False
                if (last.listener, last.index or 0) == (message.listener, message.index or 0):
                    if last.pose_id >= message.pose_id:
                        return False
                    # Only this thread appends: if the audio thread has taken this message meanwhile, it is not there.
                    self._messages[place] = arrived_s, message
                    return True
        except IndexError:
            pass
        return False

    @property
    def has_messages(self) -> bool:
        return bool(self._messages)

    @property
    def has_answers(self) -> bool:
        """Whether a response, a plan or a state of doors has arrived, which is processed before the next block."""
        return bool(self.responses or self.plans or self.doors)

    def take_messages(self) -> Iterator[tuple[float, StreamMessage]]:
        """Take the messages that wait now, each with its time of arrival."""
        for _ in range(len(self._messages)):
            yield self._messages.popleft()
