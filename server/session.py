"""One listener's stream as a state machine without input, output or waiting.

Messages go in, messages and audio blocks come out. Poses only change what is wanted: `take_request` hands out one
request for impulse responses (IRs) at a time, always for the newest poses, and whoever computes them brings the answer
back through `accept` between two blocks. Sound never waits for it.

A `Session` belongs to the thread that renders it. Positions are metres, clocks are samples.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from server.acoustics.geometry import Pose, Vector3
from server.errors import RequestError
from server.field.field import AcousticField
from server.pacing import SendWindow
from server.protocol import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    AudioBlock,
    ClientMessage,
    EmitterAdded,
    EmitterRemoved,
    Error,
    FloatArray,
    Hello,
    ListenerPose,
    MoveEmitter,
    RemoveEmitter,
    ServerMessage,
)
from server.rendering.convolver import PartitionedIr
from server.rendering.renderer import DuplicateEmitterError, Renderer, RendererFullError
from server.scene.bundle import Bundle


@dataclass(frozen=True)
class IrRequest:
    """IRs wanted for the poses as they were when `pose_id` was the newest."""

    pose_id: int
    listener: Pose
    emitters: tuple[tuple[int, Vector3], ...]
    """Serial number and position of each emitter whose IR is out of date."""


@dataclass(frozen=True)
class IrResponse:
    request: IrRequest
    irs: tuple[PartitionedIr, ...]
    """One per emitter of the request."""


def compute_irs(field: AcousticField, request: IrRequest, prepare: Callable[[FloatArray], PartitionedIr]) -> IrResponse:
    """Answer a request: milliseconds of work, for a worker thread. Raises ValueError where the field is not finite."""
    count = len(request.emitters)
    irs = field.impulse_responses(
        np.tile(np.asarray(request.listener.position), (count, 1)),
        np.asarray([position for _, position in request.emitters]),
        np.full(count, request.listener.yaw),
    )
    return IrResponse(request, tuple(prepare(ir) for ir in irs))


@dataclass
class _Emitter:
    serial: int
    position: Vector3
    is_outdated: bool = True
    token: int | None = None
    """Pose id of the newest IR handed to the renderer; None before the first."""


def _start_pose(bundle: Bundle) -> Pose:
    start = bundle.manifest.start
    return Pose.from_yaw(start.listener, math.radians(start.listener_yaw_deg))


class Session:
    """Everything one client has: poses, emitters, a renderer and the window of unacknowledged blocks.

    `load_clip` gives mono float32 at the field's rate, and is quick: it is called on the rendering thread.
    Raises RequestError for a hello that cannot be served.
    """

    def __init__(
        self,
        hello: Hello,
        field: AcousticField,
        load_clip: Callable[[str], FloatArray],
        *,
        max_emitters: int = 16,
        window: int = 40,
    ) -> None:
        if hello.protocol != PROTOCOL:
            raise RequestError(
                "unsupported_protocol",
                f"this server speaks protocol {PROTOCOL}, not {hello.protocol}",
                field="protocol",
            )
        if hello.sample_rate not in {None, field.sample_rate}:
            raise RequestError(
                "unsupported_sample_rate",
                f"scene {hello.scene!r} is rendered at {field.sample_rate} Hz: ask for that, or leave sample_rate out",
                field="sample_rate",
            )
        self.window = SendWindow(window)
        self.ir_exchanges = 0
        self.blocks_dropped = 0
        self._bundle = field.bundle
        self._load_clip = load_clip
        self._renderer = Renderer(
            block_size=hello.block_size,
            ir_samples=field.ir_samples,
            channels=field.channels,
            max_emitters=max_emitters,
        )
        self.prepare = self._renderer.prepare
        self._listener = _start_pose(self._bundle) if hello.listener is None else hello.listener.pose
        self._bundle.require_inside(self._listener.position, "listener.position")
        self._emitters: dict[str, _Emitter] = {}
        self._next_serial = 0
        self._newest_pose_id = 0
        self._accepted_pose_id = 0
        self._applied_pose_id = 0
        self._in_flight: IrRequest | None = None
        self._waits_for_change = False

    @property
    def sample_clock(self) -> int:
        """Samples rendered so far: the clock of the next block's first frame."""
        return self._renderer.sample_clock

    def receive(self, message: ClientMessage) -> list[ServerMessage]:
        """Take in one message; what is wrong with it comes back as an `Error`, and nothing has changed then."""
        try:
            match message:
                case ListenerPose():
                    self._move_listener(message)
                case MoveEmitter():
                    self._move_emitter(message)
                case AddEmitter():
                    self._add_emitter(message)
                case RemoveEmitter():
                    return self._remove_emitter(message)
                case Acknowledge():
                    self.window.acknowledge(message.sequence)
                case _:
                    raise RequestError(f"unexpected_{message.type}", f"{message.type} has no place in a running stream")
        except RequestError as refusal:
            return [Error.from_refusal(refusal)]
        return []

    def take_request(self) -> IrRequest | None:
        """The IRs to compute now. None while an earlier request is unanswered, or when every IR is up to date."""
        if self._in_flight is not None or self._waits_for_change:
            return None
        outdated = [emitter for emitter in self._emitters.values() if emitter.is_outdated]
        if not outdated:
            self._accepted_pose_id = self._newest_pose_id
            return None
        for emitter in outdated:
            emitter.is_outdated = False
        self._in_flight = IrRequest(
            self._newest_pose_id, self._listener, tuple((emitter.serial, emitter.position) for emitter in outdated)
        )
        return self._in_flight

    def accept(self, response: IrResponse) -> list[ServerMessage]:
        """Put the answer of the last request into effect, with the block that follows."""
        self._in_flight = None
        pose_id = response.request.pose_id
        arrived = {serial: ir for (serial, _), ir in zip(response.request.emitters, response.irs, strict=True)}
        events: list[ServerMessage] = []
        for identifier, emitter in self._emitters.items():
            if emitter.serial not in arrived:
                continue
            self._renderer.set_ir(identifier, arrived[emitter.serial], token=pose_id)
            if emitter.token is None:
                events.append(EmitterAdded(id=identifier, sample_clock=self.sample_clock))
            emitter.token = pose_id
        self._accepted_pose_id = pose_id
        return events

    def give_up(self, request: IrRequest) -> list[ServerMessage]:
        """Nothing answers the request: what sounds goes on with the IRs it has, until a pose or an emitter changes."""
        self._in_flight = None
        self._waits_for_change = True
        failed = {serial for serial, _ in request.emitters}
        for emitter in self._emitters.values():
            emitter.is_outdated |= emitter.serial in failed
        return [
            Error(code="field_failure", message=f"no impulse response could be computed for pose {request.pose_id}")
        ]

    def render_block(self) -> AudioBlock | None:
        """Render the next block; None when the window is full, so that it is not to be sent.

        A block that is not sent is rendered all the same: clips and reverberation keep their place on the sample clock.
        """
        sample_clock = self.sample_clock
        samples = self._renderer.process()
        self.ir_exchanges += self._renderer.exchanged
        sounding = [(name, emitter.token) for name, emitter in self._emitters.items() if emitter.token is not None]
        if all(self._renderer.applied(name) == token for name, token in sounding):
            self._applied_pose_id = self._accepted_pose_id
        if not self.window.is_open:
            self.blocks_dropped += 1
            return None
        return AudioBlock(
            sequence=self.window.take_sequence(),
            sample_clock=sample_clock,
            pose_id=self._applied_pose_id,
            samples=samples,
            is_exchange=self._renderer.exchanged,
        )

    def _move_listener(self, message: ListenerPose) -> None:
        pose = message.pose
        self._bundle.require_inside(pose.position, "position")
        self._advance_pose_id(message.pose_id)
        self._listener = pose
        for emitter in self._emitters.values():
            emitter.is_outdated = True

    def _move_emitter(self, message: MoveEmitter) -> None:
        emitter = self._require_emitter(message.id)
        self._bundle.require_inside(message.position, "position")
        self._advance_pose_id(message.pose_id)
        emitter.position = message.position
        emitter.is_outdated = True

    def _advance_pose_id(self, pose_id: int) -> None:
        if pose_id <= self._newest_pose_id:
            raise RequestError(
                "stale_pose", f"pose {pose_id} is not newer than {self._newest_pose_id}", field="pose_id"
            )
        self._newest_pose_id = pose_id
        self._waits_for_change = False

    def _add_emitter(self, message: AddEmitter) -> None:
        self._bundle.require_inside(message.position, "position")
        clip = self._load_clip(message.clip)
        try:
            self._renderer.add_emitter(message.id, clip, gain=10 ** (message.gain_db / 20), loop=message.loop)
        except DuplicateEmitterError as exc:
            raise RequestError("duplicate_emitter", f"emitter {message.id!r} is already there", field="id") from exc
        except RendererFullError as exc:
            raise RequestError("too_many_emitters", str(exc)) from exc
        self._emitters[message.id] = _Emitter(self._next_serial, message.position)
        self._next_serial += 1
        self._waits_for_change = False

    def _remove_emitter(self, message: RemoveEmitter) -> list[ServerMessage]:
        self._require_emitter(message.id)
        del self._emitters[message.id]
        self._renderer.remove_emitter(message.id)
        return [EmitterRemoved(id=message.id)]

    def _require_emitter(self, identifier: str) -> _Emitter:
        if identifier not in self._emitters:
            raise RequestError("unknown_emitter", f"there is no emitter {identifier!r}", field="id", status=404)
        return self._emitters[identifier]
