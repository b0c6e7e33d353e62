"""The asyncio driver of a WebSocket stream. It moves data between the socket, the session and the audio thread.

Each client has one `Connection`, which lives on the event loop. A reader passes the client's messages to the audio
thread, and a sender passes the audio thread's output to the socket. Nothing grows without bound: messages to the audio
thread are refused beyond `MAX_WAITING_MESSAGES`, audio beyond the window is never sent, and a client that reads so
slowly that its messages pile up is cut off. So is a client that acknowledges nothing for `stall_timeout_s`.

A connection takes up one of the server's streams only with its hello. The number of connections without a hello is
limited: one too many ends the one that has been silent for longest, so that silent clients keep no others out.

If a connection is lost, a snapshot of its stream is kept (`server.api.kept_streams`). A new connection that begins with
a `resume` opens a stream in that state, at the sample clock which the lost one would have reached by then.

The reason for ending a connection is returned and not raised. An exception kept by a task refers to frames that refer
to the task, and a session in that cycle would stay in memory until the garbage collector runs.
"""

import asyncio
import contextlib
import dataclasses
import logging
import math
import re
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

from starlette.responses import Response
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from server.acoustics.geometry import Pose
from server.acoustics.spherical_harmonics import harmonic_count
from server.api.access import Access, Caller, Ending
from server.api.access_gate import caller_of
from server.api.block_encoding import CHANNEL_SHARE, BlockEncoding
from server.api.catalogue import describe_scene
from server.api.http_durations import HttpDurations
from server.api.inflow import LISTENER_COST, Allowance
from server.api.kept_streams import KeptStream, KeptStreams
from server.api.problems import problem
from server.api.process_peers import AskedStream, MovedStream, ProcessPeers, ToldStream, random_token
from server.api.request_log import RefusedRequests
from server.api.response_cache import ResponseCache
from server.api.settings import Settings
from server.api.stream_counts import StreamLedger
from server.api.turn_taking import OneAtATime
from server.api.uploads import Uploads
from server.api.web_socket import FastPath
from server.assets.clip_store import ClipStore, is_upload
from server.assets.clips import ClipLibrary, DecodeError
from server.assets.hrtfs import DEFAULT_HRTF, HrtfLibrary
from server.core.errors import RequestError
from server.core.stores import StoreCalls
from server.field.fields_by_level import FieldsByLevel
from server.planning.cost import Costs
from server.planning.places import place_of
from server.planning.scene_acoustics import Reverberation, SceneAcoustics
from server.protocol.blocks import DryBlock, DryPackets
from server.protocol.client_messages import (
    AUTO,
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    AddListener,
    ClientMessage,
    Hello,
    ListenerPose,
    MoveEmitter,
    Ping,
    RemoveEmitter,
    RemoveListener,
    Resume,
    SetEffects,
    SetLevel,
    emitter_of,
    ids_named_by,
    listener_of,
    parse_client_message,
    require_protocol,
)
from server.protocol.codecs.registry import SampleEncoding, is_of_samples, require_encoding
from server.protocol.codes import (
    ACCESS_ENDED,
    GOODBYES,
    INTERNAL_ERROR,
    LOST,
    NORMAL,
    POLICY_VIOLATION,
    SERVICE_RESTART,
    TAKEN_OVER,
    TRY_AGAIN_LATER,
)
from server.protocol.opus import OpusOptions
from server.protocol.packets import BlockEncoder, LiveDecoders
from server.protocol.server_messages import (
    EmitterEnded,
    Error,
    ListenerRemoved,
    Pong,
    Resumed,
    ResumedListener,
    ServerMessage,
    SnapshotTaken,
    Welcome,
)
from server.protocol.snapshot import MOST_BYTES, KeptListener, Seal, Snapshot
from server.rendering.hrtf import HeadFilters
from server.rendering.ingest import DryAudio
from server.runtime.logs import about
from server.runtime.racing import StoppedError, run_until
from server.runtime.readiness import Readiness
from server.runtime.thread_pool import ThreadPool
from server.runtime.traces import span
from server.streaming.admission import Admission, Place, Refusal
from server.streaming.audience import NewListener, Roster
from server.streaming.audio_engine import AudioEngine
from server.streaming.calibration import calibrate
from server.streaming.headroom import RenderCost, StreamKind
from server.streaming.inbox import ChosenSteps, TakeSnapshot
from server.streaming.load_policy import Ladder
from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.quality_steps import Offer, QualityStep
from server.streaming.render_costs import kind_of, measure_rendering
from server.streaming.session import Session
from server.streaming.stream import Outgoing, Stream, StreamFailed, StreamState, TimedBlock

_logger = logging.getLogger(__name__)

MAX_WAITING_ANSWERS = 256
SUBPROTOCOL: Final = f"nafir.v{PROTOCOL}"
"""The subprotocol that is chosen if a client offers it. Browsers close a connection without a choice."""
_GOODBYE_S = 1.0
"""Limit for sending the close frame. It waits for room in the socket, which a client that does not read never makes."""
_STATE_S = 1.0
"""Limit for the state of a stream to come from its audio thread, which is woken for it."""
_SNAPSHOT_PERIOD_S = 3.0
"""Time between two snapshots of a stream: what its client would have to send again if the server was lost."""
_MOST_DEPARTED_WORK = 4
"""Responses and plans for listeners who have left that may still be computed while another listener comes."""
_CLIP_WAIT_S = 5.0
"""Time for an uploaded clip to come from another machine, before its emitter is refused. It comes all the same."""
_MOST_HELD = 256
"""Messages that may wait, already read, for a clip to come."""
_UNCOUNTED: Final = ListenerPose | MoveEmitter | DryBlock | DryPackets | Acknowledge | Ping
"""Messages that do not count as handled (`Snapshot.handled`): they have numbers of their own, or need not be sent
again."""
_UNCOUNTED_TYPE: Final = re.compile(r'"type"\s*:\s*"(listener|move_emitter|acknowledge|ping)"')


def load_clip(clips: ClipLibrary, uploads: ClipStore | None, name: str) -> DryAudio:
    """Raises RequestError unknown_clip, or undecodable_clip with the decoder's reason."""
    try:
        return uploads.load(name, clips.sample_rate) if uploads is not None and is_upload(name) else clips.load(name)
    except DecodeError as exc:
        raise RequestError("undecodable_clip", str(exc), field="clip") from exc


def loaded_clip(clips: ClipLibrary, uploads: ClipStore | None, name: str) -> DryAudio:
    """What `load_clip` has just loaded, at once. Raises RequestError server_busy if so many uploaded clips were loaded
    since then that it is not there any more."""
    if uploads is None or not is_upload(name):
        return load_clip(clips, None, name)
    audio = uploads.loaded(name, clips.sample_rate)
    if audio is None:
        raise RequestError("server_busy", f"too many clips are in use to play {name}", field="clip", retry_after_s=1)
    return audio


def _forget(task: asyncio.Task[None] | asyncio.Task[str | bytes]) -> None:
    """Nothing is reported of a task that nothing waits for any more."""
    if not task.cancelled():
        task.exception()


def _first_blocks(outgoing: Iterable[Outgoing]) -> Iterator[TimedBlock]:
    """The blocks at the beginning, up to the first message that is not a block."""
    for each in outgoing:
        if not isinstance(each, TimedBlock):
            return
        yield each


@dataclass(frozen=True)
class Goodbye:
    """The end of a connection: an error message and the code of the close frame after it."""

    close_code: int
    error: Error


_TOO_SLOW: Final = Goodbye(POLICY_VIOLATION, Error(code="reads_too_slowly", message="the client reads too slowly"))
_TAKEN_OVER: Final = Goodbye(
    TAKEN_OVER, Error(code="taken_over", message="the client has resumed the stream on another connection")
)
_FAILED: Final = Goodbye(INTERNAL_ERROR, Error(code="internal_error", message="the stream failed"))

_EXPIRED: Final = Error(code="key_expired", message="the key or token has expired: connect again with a new one")
_REVOKED: Final = Error(code="key_revoked", message="the key, or the one that signed the token, was revoked or changed")
_ENDINGS: Final[Mapping[Ending, Goodbye]] = {
    "key_expired": Goodbye(ACCESS_ENDED, _EXPIRED),
    "key_revoked": Goodbye(ACCESS_ENDED, _REVOKED),
}


def _counts(message: ClientMessage | None, data: str | bytes) -> bool:
    """Whether a client may have to send a message again after a resume, unless it was handled (`Snapshot.handled`).
    `message` is None if it could not be read."""
    if message is not None:
        return not isinstance(message, _UNCOUNTED)
    return isinstance(data, str) and _UNCOUNTED_TYPE.search(data) is None


def _refused(refusal: RequestError) -> Goodbye:
    return Goodbye(POLICY_VIOLATION, Error.from_refusal(refusal))


def _busy(refusal: Refusal) -> Goodbye:
    return Goodbye(TRY_AGAIN_LATER, Error.from_refusal(refusal.error))


async def _end_of_access(access: Access, caller: Caller) -> Goodbye:
    """Return once a client's key or token ends."""
    return _ENDINGS[await access.ended(caller)]


@dataclass(frozen=True)
class MeasuredScene:
    """A scene that can be offered: its levels, its clips, its acoustics, and what it costs on this host."""

    levels: FieldsByLevel
    clips: ClipLibrary
    place: SceneAcoustics
    offer: Offer
    render_costs: Mapping[str, RenderCost]


@dataclass(frozen=True)
class _Scene:
    """What the sessions of a stream need of its scene besides the levels, as it was offered when the stream was opened:
    another may be offered under the same id before a listener or an emitter comes."""

    clips: ClipLibrary
    """At the stream's sample rate."""
    reverberations: tuple[Reverberation, ...]
    effect_costs: Mapping[int | None, Costs]


@dataclass(frozen=True)
class _LostStream:
    """A stream that a client has `asked` to go on with."""

    asked: Resume
    kept: KeptStream
    snapshot: Snapshot
    outcome: Literal["resumed", "resumed_from_snapshot"]
    """As what it is counted once it goes on."""


@dataclass
class StreamHost:
    """State that all connections share: loaded scenes, clips, heads, the audio engine and the number of streams.
    `offers` has the cost of each scene's quality levels on this host once it is measured."""

    scenes: dict[str, FieldsByLevel]
    clips: dict[str, ClipLibrary]
    """Clip libraries by scene; each has the scene's sample rate, and one for each other rate of streams."""
    hrtfs: HrtfLibrary
    audio: AudioEngine
    settings: Settings
    responses: ResponseCache
    readiness: Readiness
    encoders: ThreadPool
    """The threads that encode blocks in encodings that take their time."""
    uploads: Uploads | None = None
    """Takes clips that clients upload, if the server does."""
    peers: ProcessPeers | None = None
    """The processes that serve at one port, if this is one of them."""
    access: Access | None = None
    """The keys in force; None if everybody may use the server."""
    offers: dict[str, Offer] = dataclasses.field(default_factory=dict)
    other_offers: dict[tuple[str, int, int | None], Offer] = dataclasses.field(default_factory=dict)
    """The same for streams at another sample rate than the scene's, or of ambisonics: by scene, rate and order, once
    one was asked for."""
    places: dict[str, SceneAcoustics] = dataclasses.field(default_factory=dict)
    """Acoustics of each scene, for the planner of effects."""
    effect_costs: dict[str, Mapping[int | None, Costs]] = dataclasses.field(default_factory=dict)
    """Costs of effects by scene, once they are measured, for each order of its levels' buses and without one (None)."""
    render_costs: dict[tuple[str, int], Mapping[str, RenderCost]] = dataclasses.field(default_factory=dict)
    """Costs of rendering by scene and sample rate, and quality level, once they are measured."""
    refused_bundles: int = 0
    """Bundles of the folder that is watched which cannot be loaded."""
    stores: Mapping[str, StoreCalls] = dataclasses.field(default_factory=dict)
    """Calls of the stores of bundles and of clips, of those that there are."""
    refused_requests: RefusedRequests = dataclasses.field(default_factory=RefusedRequests)
    """Counts of requests that were refused because of who asked."""
    http_durations: HttpDurations = dataclasses.field(default_factory=HttpDurations)
    """How long answers to requests took."""
    ledger: StreamLedger = dataclasses.field(default_factory=StreamLedger)
    """Counts of all streams, open and ended."""
    admission: Admission = dataclasses.field(init=False)
    """The places of all streams, open or being opened."""
    kept: KeptStreams = dataclasses.field(init=False)
    """Streams that have lost their clients."""
    seal: Seal | None = dataclasses.field(init=False)
    """Signs snapshots; None without a secret."""
    wall_s: Callable[[], float] = time.time
    """The clock that hosts share, in seconds since 1970."""
    openings: OneAtATime = dataclasses.field(default_factory=OneAtATime)
    """Creates sessions one after the other, since each takes about 8 ms of CPU time."""
    settling: set[asyncio.Task[None]] = dataclasses.field(default_factory=set)
    """Tasks that tell other processes what became of their streams."""
    silent: dict[asyncio.Timeout, None] = dataclasses.field(default_factory=dict)
    """Timeouts of the connections that have not sent a hello, oldest first."""

    def __post_init__(self) -> None:
        self.admission = Admission(
            self.audio,
            most_streams=self.settings.max_streams,
            cores=self.settings.cores,
            is_on=self.settings.admission,
            thresholds=dataclasses.replace(THRESHOLDS, ir_share=self.settings.ir_share),
        )
        secret = self.settings.resume_secret
        self.seal = (
            None
            if secret is None
            else Seal(secret.get_secret_value().encode(), lifetime_s=self.settings.snapshot_lifetime_s)
        )
        self.kept = KeptStreams(
            keep_s=self.settings.resume_s,
            most=self.settings.max_streams,
            give_up=self.admission.leave,
            new_token=random_token if self.peers is None else self.peers.new_token,
        )

    @property
    def clip_store(self) -> ClipStore | None:
        """The clips that were uploaded; None if the server takes none."""
        return None if self.uploads is None else self.uploads.store

    @property
    def streams(self) -> int:
        """Number of streams that are open or being opened."""
        return self.admission.streams - self.admission.held

    def kind_of(self, hello: Hello, levels: FieldsByLevel) -> StreamKind | None:
        """The kind of stream that a hello asks for; None until it is measured what rendering costs."""
        costs = self.render_costs.get((hello.scene, levels.default.sample_rate))
        if costs is None:
            return None
        order = hello.ambisonic_order
        kind = kind_of(levels, costs, block_size=hello.block_size, order=order)
        if is_of_samples(hello.encoding):
            return kind
        channels = (1 if hello.output == "mono" else 2) if order is None else harmonic_count(order)
        return dataclasses.replace(kind, encoding=CHANNEL_SHARE * channels)

    def turn_away(self) -> Response | None:
        """The answer to whoever asks for a stream while not even the cheapest has room; None if one has, or if it may
        be a client that comes back."""
        if self.readiness.obstacle is not None:
            return None  # which a client is told in the stream
        if self.kept.has_places or any(stream.stalled_s > 0 for stream in self.audio.streams):
            return None
        refusal = self.admission.turn_away()
        if refusal is None:
            return None
        error = refusal.error
        return problem(503, error.code, str(error), retry_after_s=error.retry_after_s)

    async def take_kept(self, token: str, *, owner: str | None) -> KeptStream | None:
        """The stream of a token, from this process or from another that serves at the same port; None if none has
        it."""
        kept = await self.kept.take(token, owner=owner)
        if kept is not None or self.peers is None:
            return kept
        moved_to = self.kept.moved_to(token)
        number = self.peers.home_of(token) if moved_to is None else moved_to
        moved = await self.peers.take(token, owner, number)
        return None if moved is None else KeptStream.moved(moved, token, owner)

    async def lend_kept(self, asked: AskedStream) -> ToldStream:
        """The stream of a token for another process. It is still kept here until that process says what became of
        it."""
        kept = await self.kept.lend(asked.token, owner=asked.owner)
        if kept is None or self.peers is None:
            return ToldStream(moved_to=self.kept.moved_to(asked.token))
        return ToldStream(stream=MovedStream(kept.data.decode(), kept.plays_s, kept.until_s, self.peers.number))

    def settle(self, kept: KeptStream, *, is_resumed: bool) -> None:
        """Say what became of a stream that was taken, where it was kept."""
        if kept.lender is not None and self.peers is not None:
            telling = asyncio.create_task(self.peers.settle(kept.lender, kept.tokens[0], is_resumed=is_resumed))
            self.settling.add(telling)
            telling.add_done_callback(self.settling.discard)
        elif not is_resumed:
            self.kept.put_back(kept)

    def take(self, scene: "MeasuredScene") -> None:
        """Offer a scene from now on, in place of any other with its id. Streams that are open keep theirs."""
        levels = scene.levels
        name, rate = levels.bundle.id, levels.own_rate
        self._forget_costs(name)
        self.hrtfs.offer(rate)
        self.clips[name] = scene.clips
        self.places[name] = scene.place
        self.offers[name] = scene.offer
        self.render_costs[name, rate] = scene.render_costs
        self.scenes[name] = levels

    def offered(self, scene: str, levels: FieldsByLevel) -> _Scene:
        """What is offered now of a scene besides its levels, at their sample rate."""
        rate = levels.default.sample_rate
        # What effects cost is measured at the scene's own rate, and no plan says what is true of another.
        costs = self.effect_costs.get(scene, {}) if rate == levels.own_rate else {}
        return _Scene(self.clips[scene].at_rate(rate), self.places[scene].reverberations, costs)

    def drop(self, scene: str) -> None:
        """Offer a scene no longer. Streams of it go on, with its clips."""
        self.scenes.pop(scene, None)
        self.offers.pop(scene, None)
        self._forget_costs(scene)

    def _forget_costs(self, scene: str) -> None:
        self.effect_costs.pop(scene, None)
        self.other_offers = {key: offer for key, offer in self.other_offers.items() if key[0] != scene}
        self.render_costs = {key: costs for key, costs in self.render_costs.items() if key[0] != scene}

    def measure(self, scene: str, levels: FieldsByLevel, order: int | None) -> Offer:
        """Measure what responses of a scene's levels cost on this host at their sample rate, ambisonic ones with an
        `order`; and what rendering at that rate costs. Keep the results. This is work for another thread."""
        rate = levels.default.sample_rate
        offer = self.other_offers.get((scene, rate, order))
        if offer is None:
            head = self.head(DEFAULT_HRTF, levels)
            if (scene, rate) not in self.render_costs:
                whole = self.scenes.get(scene, levels).at_rate(rate)
                self.render_costs[scene, rate] = measure_rendering(whole, *head)
            offered = tuple(levels[name].level for name in levels.names)
            offer = Offer(offered, calibrate(levels, *head, order=order))
            self.other_offers[scene, rate, order] = offer
        return offer

    def head(self, name: str, levels: FieldsByLevel) -> tuple[HeadFilters, HeadFilters]:
        """The filters of a head at the rate of some levels, and at their scene's own. Raises RequestError
        unknown_hrtf."""
        rates = levels.default.sample_rate, levels.own_rate
        at_rate, at_own = (self.hrtfs.filters(name, rate) for rate in rates)
        return at_rate, at_own

    def await_hello(self, patience: asyncio.Timeout) -> None:
        """Note a connection that has not sent its hello yet. If there are too many, end the oldest."""
        self.silent[patience] = None
        if len(self.silent) > self.settings.max_silent:
            longest = next(iter(self.silent))
            del self.silent[longest]
            longest.reschedule(asyncio.get_running_loop().time())


class Connection:
    """One client's connection from its hello to its end. `fast_path` bypasses ASGI if the server has one."""

    def __init__(
        self,
        websocket: WebSocket,
        host: StreamHost,
        *,
        fast_path: FastPath | None = None,
        time_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._websocket = websocket
        self._fast_path = fast_path
        self._host = host
        self._time_s = time_s
        self._outgoing: deque[Outgoing] = deque()
        self._has_outgoing = asyncio.Event()
        self._is_sending = self._is_handling = False
        self._held: deque[str | bytes] = deque()
        """Messages that were read while another was being handled."""
        self._receiving: asyncio.Task[str | bytes] | None = None
        """The next message, if it was awaited while another was being handled."""
        self._capacity = MAX_WAITING_ANSWERS
        self._goodbye: Goodbye | None = None
        """Why the connection is to end."""
        self._is_ending = asyncio.Event()
        self._caller = caller_of(websocket.scope)
        self._owner = None if self._caller is None else self._caller.identity
        """Who may resume the stream."""
        self._left_with: int | None = None
        """The close code with which the client left, once it is known."""
        self._stream: Stream | None = None
        self._place: Place | None = None
        self._scene: _Scene | None = None
        self._encoding: SampleEncoding = "f32"
        """How blocks without packets are sent."""
        self._block_encoding: BlockEncoding | None = None
        self._live_decoders: LiveDecoders | None = None
        self._roster = Roster(host.settings.max_listeners)
        self._window = 0
        """Blocks of a listener that may be unacknowledged."""
        self._allowed = 1
        """The most listeners for whose messages the client has had an allowance."""
        self._session = ""
        self._token: str | None = None
        self._is_confirmed = False
        """Whether the client has shown that it has the token."""
        self._has_resumed = False
        self._handled = 0
        self._parting: SnapshotTaken | None = None
        """The last snapshot, for a client whose stream the shutdown has ended."""
        self._state: asyncio.Future[StreamState] | None = None
        """The state that the audio thread was asked for."""
        self._figures: dict[str, float] | None = None
        """What is told of a stream when it has ended."""

    async def run(self) -> None:
        """Serve the client until either side ends it."""
        with contextlib.suppress(WebSocketDisconnect), self._host.readiness.drain.in_flight():
            if (refusal := self._host.turn_away()) is not None:
                await self._websocket.send_denial_response(refusal)
                return
            offered = self._websocket.scope.get("subprotocols", ())
            await self._websocket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
            goodbye = await self._serve_until_drained()
            self._log_end(goodbye)
            if goodbye is not None:
                await self._say(goodbye)

    def _log_end(self, goodbye: Goodbye | None) -> None:
        """Say why a connection has ended."""
        reason: dict[str, object] = {"reason": "client_left", "close_code": self._left_with or LOST}
        if goodbye is not None:
            error = goodbye.error
            reason = {"reason": error.code, "close_code": goodbye.close_code, "detail": error.message}
        if self._figures is None:
            _logger.info("stream not opened", extra=reason)
        else:
            _logger.info("stream ended", extra={"session": self._session, **reason, **self._figures})

    async def _say(self, goodbye: Goodbye) -> None:
        with contextlib.suppress(TimeoutError, WebSocketDisconnected):  # a client that has gone is told nothing
            async with asyncio.timeout(_GOODBYE_S):
                if self._parting is not None:
                    await self._send_message(self._parting)
                await self._send_message(goodbye.error)
                await self._websocket.close(goodbye.close_code, goodbye.error.code)

    async def _serve_until_drained(self) -> Goodbye | None:
        drain = self._host.readiness.drain
        if drain.has_begun:
            return self._draining()
        try:
            return await run_until(self._serve(), drain.turn())
        except StoppedError:
            return self._draining()

    def _draining(self) -> Goodbye:
        """What a client is told during the shutdown: when and how to go on."""
        seconds = self._host.readiness.drain.streams_retry_after_s
        how = "open the stream again" if self._parting is None else "resume with the snapshot"
        where = "another takes it now" if seconds is None else f"at another or here in {seconds} s"
        message = f"the server is shutting down: {how}, {where}"
        return Goodbye(SERVICE_RESTART, Error(code="server_draining", message=message, retry_after_s=seconds))

    async def _serve(self) -> Goodbye | None:
        """Serve the client. Returns None if the client has gone, or else the reason to end the connection."""
        host = self._host
        if (obstacle := host.readiness.obstacle) is not None:
            return Goodbye(TRY_AGAIN_LATER, Error(code="not_ready", message=obstacle.message))
        first = await self._receive_first()
        if isinstance(first, Goodbye):
            return first
        if host.readiness.drain.has_begun:
            return self._draining()
        if isinstance(first, Hello):
            return await self._serve_stream(first, None)
        try:
            lost = await self._find(first)
        except RequestError as refusal:
            return _refused(refusal)
        try:
            return await self._serve_stream(lost.snapshot.hello, lost)
        finally:
            if not self._has_resumed:
                host.settle(lost.kept, is_resumed=False)

    async def _serve_stream(self, hello: Hello, lost: _LostStream | None) -> Goodbye | None:
        host = self._host
        try:
            levels, offer = await self._require_offer(hello)
            if offer is None:
                return None
            steps, others = self._steps(hello, levels, offer)
            self._require_seats(hello)
            if lost is not None:
                await self._load_clips(lost.snapshot)
        except RequestError as refusal:
            return _refused(refusal)
        place = None if lost is None else lost.kept.place
        if place is None:
            kind, listeners = host.kind_of(hello, levels), hello.listeners or 1
            admitted = host.admission.admit(kind, steps, hello.emitters, listeners=listeners, others=others)
            if isinstance(admitted, Refusal):
                return _busy(admitted)
            place = admitted
        try:
            if lost is None or lost.kept.place is None:
                missed = await host.admission.take_turn(place, is_there=self._is_there)
                if missed is not None:
                    return _busy(missed)
            first_step = steps.index(place.step) if place.step in steps else 0
            with span("open stream", {"nafir.scene": hello.scene, "nafir.is_resumed": lost is not None}):
                stream = await self._open(hello, levels, offer, Ladder(steps, first_step, let_in_at=first_step), lost)
            if stream is None or isinstance(stream, Goodbye):
                return stream
            place.listeners = len(stream.audience.members)
            host.admission.open(place, stream)
            if lost is not None:
                host.kept.outcomes[lost.outcome] += 1
                host.settle(lost.kept, is_resumed=True)
            return await self._pump(stream, hello, place)
        finally:
            if self._token is not None:
                host.kept.close(self._token)
            if not place.is_kept:
                host.admission.leave(place)

    async def _load_clips(self, snapshot: Snapshot) -> None:
        """Load what was uploaded and plays in a lost stream, as far as it comes in time: another server may have had
        the stream. What is not loaded is refused when the stream is restored."""
        scene, uploads = self._scene, self._host.uploads
        if scene is None or uploads is None:
            return

        async def load(name: str) -> None:
            with contextlib.suppress(RequestError):
                await uploads.bring(name)
                await asyncio.to_thread(load_clip, scene.clips, uploads.store, name)

        names = {kept.emitter.clip for kept in snapshot.emitters if kept.emitter.clip is not None}
        rate = scene.clips.sample_rate
        missing = [name for name in names if is_upload(name) and uploads.store.loaded(name, rate) is None]
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_CLIP_WAIT_S):
                await asyncio.gather(*map(load, missing))

    def _require_seats(self, hello: Hello) -> None:
        """Raises RequestError too_many_listeners."""
        most = self._host.settings.max_listeners
        # guard: a hello asks for no more listeners than there may be
        if (hello.listeners or 1) > most:
            raise RequestError("too_many_listeners", f"a stream has at most {most} listeners", field="listeners")

    async def _receive_first(self) -> Hello | Resume | Goodbye:
        host = self._host
        try:
            async with asyncio.timeout(host.settings.hello_timeout_s) as patience:
                host.await_hello(patience)
                try:
                    first = await self._receive()
                finally:
                    host.silent.pop(patience, None)
            if isinstance(first, bytes):
                raise RequestError("hello_expected", "the first message is a hello, as JSON text, and not binary")
            message = self._parse(first)
        except TimeoutError:
            return Goodbye(POLICY_VIOLATION, Error(code="hello_expected", message="no hello came in time"))
        except RequestError as refusal:
            return _refused(refusal)
        if not isinstance(message, Hello | Resume):
            error = Error(code="hello_expected", message=f"the first message is a hello, not {message.type}")
            return Goodbye(POLICY_VIOLATION, error)
        return message

    async def _find(self, asked: Resume) -> _LostStream:
        """Take over the stream that a client asks for. Raises RequestError unknown_resume_token, and
        unsupported_protocol."""
        require_protocol(asked)
        host = self._host
        kept = None if asked.token is None else await host.take_kept(asked.token, owner=self._owner)
        outcome: Literal["resumed", "resumed_from_snapshot"] = "resumed"
        if kept is None and asked.snapshot is not None and host.seal is not None:
            data, plays_at = host.seal.open(asked.snapshot, now=host.wall_s(), owner=self._owner or "")
            kept = KeptStream(data, self._time_s() + plays_at - host.wall_s())
            outcome = "resumed_from_snapshot"
        if kept is None:
            host.kept.outcomes["unknown"] += 1
            problem = f"no stream is kept for this token, or its {host.kept.keep_s:g} s are over: send a hello"
            raise RequestError("unknown_resume_token", problem, field="token", status=404)
        try:
            return _LostStream(asked, kept, Snapshot.parse(kept.data), outcome)
        except RequestError:
            if kept.place is not None:
                self._host.admission.leave(kept.place)
            raise

    async def _require_offer(self, hello: Hello) -> tuple[FieldsByLevel, Offer | None]:
        """The levels that a hello may have, and their costs; None for these if the client has gone meanwhile. Raises
        RequestError for a scene, an output, a sample rate or a head that there is not."""
        levels = self._host.scenes.get(hello.scene)
        if levels is None:
            raise RequestError("unknown_scene", f"there is no scene {hello.scene!r}", field="scene", status=404)
        levels = levels.at_rate(hello.sample_rate)
        self._scene = self._host.offered(hello.scene, levels)
        require_encoding(hello.encoding, levels.default.sample_rate)
        if hello.ambisonic_order is not None:
            levels = levels.with_directions(hello.level)
        if levels.default.sample_rate != levels.own_rate:
            # Not within an opening, for which others wait: a large head takes many seconds when a rate is first used.
            for head in {DEFAULT_HRTF, hello.hrtf or DEFAULT_HRTF}:
                await asyncio.to_thread(self._host.head, head, levels)
        return levels, await self._offer(hello, levels)

    def _steps(
        self, hello: Hello, levels: FieldsByLevel, offer: Offer
    ) -> tuple[tuple[QualityStep, ...], tuple[QualityStep, ...]]:
        """The steps of the level that a hello asks for, and for another level than auto those of auto."""
        block_s = hello.block_size / levels.default.sample_rate
        steps = offer.steps(hello.level, block_s=block_s)
        return steps, () if hello.level == AUTO else offer.steps(AUTO, block_s=block_s)

    async def _open(
        self, hello: Hello, levels: FieldsByLevel, offer: Offer, ladder: Ladder, lost: _LostStream | None
    ) -> Stream | Goodbye | None:
        """Open a stream, or go on with a `lost` one. Returns None if the client has gone meanwhile."""
        settings = self._host.settings
        field = levels.default
        hrtf = DEFAULT_HRTF if hello.hrtf is None else hello.hrtf
        window = math.ceil(settings.window_blocks * field.sample_rate / levels.own_rate) + hello.buffer_blocks
        self._window, self._capacity = window, window + MAX_WAITING_ANSWERS
        try:
            opened = await self._host.openings.run(
                partial(self._open_session, hello, levels, hrtf, ladder.step, window, lost), is_wanted=self._is_there
            )
        except RequestError as refusal:
            return _refused(refusal)
        if opened is None:
            return None
        session, others, errors = opened
        block_s = hello.block_size / field.sample_rate
        encoder = None
        if is_of_samples(hello.encoding):
            self._encoding = hello.encoding
        else:
            options = OpusOptions() if hello.opus is None else hello.opus
            channels = session.renderer.outputs
            new_encoder = partial(BlockEncoder, options, channels=channels, sample_rate=field.sample_rate)
            encoder = new_encoder()
            self._block_encoding = BlockEncoding(
                new_encoder,
                self._host.encoders,
                block_s=hello.block_size / field.sample_rate,
                capacity=self._capacity,
                post=asyncio.get_running_loop().call_soon_threadsafe,
                deliver=self._send_encoded,
            )
        self._live_decoders = LiveDecoders(field.sample_rate, settings.max_emitters)
        self._session = uuid.uuid4().hex if lost is None else lost.snapshot.session
        if self._host.kept.keep_s:
            former = lost.asked.token if lost is not None and lost.kept.tokens else None
            self._token = self._host.kept.open(partial(self._end, _TAKEN_OVER), owner=self._owner, former=former)
        await self._send_message(
            Welcome(
                session=self._session,
                scene=describe_scene(levels),
                sample_rate=field.sample_rate,
                block_size=hello.block_size,
                channels=session.renderer.outputs,
                encoding=hello.encoding,
                buffer_blocks=hello.buffer_blocks,
                window=window,
                ir_samples=field.ir_samples,
                hrtf=hrtf,
                level=ladder.step.level,
                max_emitters=settings.max_emitters,
                max_listeners=None if hello.listeners is None else settings.max_listeners,
                resume_token=self._token,
                resume_s=None if self._token is None else self._host.kept.keep_s,
                resumed=None if lost is None else self._continue(session, others, lost, block_s),
                order=hello.ambisonic_order,
                opus=None if encoder is None else encoder.streams,
                doors=session.doors,
            )
        )
        self._enqueue(errors)
        stream = Stream(
            session,
            levels,
            offer=offer,
            ladder=ladder,
            block_s=block_s,
            lead=hello.buffer_blocks,
            deliver=self._deliver,
        )
        for each in others:
            stream.audience.join(each, ladder.step, sequence=session.window.next_sequence)
            self._widen(1)
        return stream

    def _continue(self, session: Session, others: Sequence[NewListener], lost: _LostStream, block_s: float) -> Resumed:
        """Set the clock of a session to where that of a `lost` stream would be if the next block played now."""
        snapshot, sequence = lost.snapshot, lost.asked.sequence
        most = math.ceil(max(self._host.kept.keep_s, self._host.settings.snapshot_lifetime_s) / block_s)
        blocks = math.ceil((self._time_s() - lost.kept.plays_s) / block_s) + 1
        if lost.asked.sample_clock is not None:  # the clock never goes back, even if that of a host does
            blocks = max(blocks, (lost.asked.sample_clock - snapshot.sample_clock) // snapshot.hello.block_size + 1)
        blocks = min(max(0, blocks), most)
        sample_clock = snapshot.sample_clock + blocks * snapshot.hello.block_size
        resumed = Resumed(
            sample_clock=sample_clock,
            sequence=snapshot.sequence if sequence is None else sequence + 1,
            pose_id=snapshot.pose_id,
            handled=snapshot.handled,
            listeners=tuple(ResumedListener(id=each.message.id, index=each.session.index) for each in others),
        )
        session.continue_at(resumed.sample_clock, resumed.sequence)
        self._handled = snapshot.handled
        return resumed

    async def _offer(self, hello: Hello, levels: FieldsByLevel) -> Offer | None:
        """The levels for a hello, with their costs. Those of an ambisonic order, or of another sample rate than the
        scene's, are measured when a stream first asks for them. Returns None if the client has gone meanwhile."""
        host, order, rate = self._host, hello.ambisonic_order, levels.default.sample_rate
        if order is None and rate == levels.own_rate:
            return host.offers[hello.scene]
        measured = host.other_offers.get((hello.scene, rate, order))
        if measured is None:
            measured = await host.openings.run(
                partial(host.measure, hello.scene, levels, order), is_wanted=self._is_there
            )
        return measured

    def _is_there(self) -> bool:
        return self._fast_path is None or self._fast_path.is_open()

    def _open_session(
        self,
        hello: Hello,
        levels: FieldsByLevel,
        hrtf: str,
        quality: QualityStep,
        window: int,
        lost: _LostStream | None,
    ) -> tuple[Session, list[NewListener], list[ServerMessage]]:
        """The session of the first listener, those of others that a `lost` stream had, and what of it could not be
        restored."""
        session = self._new_session(hello, levels, hrtf, quality, window)
        if lost is None:
            return session, [], []
        errors, others = session.restore(lost.snapshot), []
        for kept in lost.snapshot.listeners:
            try:
                others.append(self._restored_listener(kept, hello, levels, quality))
            except RequestError as refusal:
                errors.append(Error.from_refusal(refusal, listener=kept.listener.id))
        return session, others, errors

    def _restored_listener(
        self, kept: KeptListener, hello: Hello, levels: FieldsByLevel, quality: QualityStep
    ) -> NewListener:
        """A listener that a lost stream had. Raises RequestError as `_new_listener` does."""
        message = kept.listener
        number = self._roster.enter(message.id, kept.index)
        try:
            return self._new_listener(message, number, hello, levels, quality)
        except RequestError:
            # guard: who cannot be there again takes no seat and no name
            self._roster.leave(message.id)
            raise

    def _new_listener(
        self, message: AddListener, number: int, hello: Hello, levels: FieldsByLevel, quality: QualityStep
    ) -> NewListener:
        """A listener with a session that has rendered nothing yet. Raises RequestError unknown_hrtf, and
        position_out_of_bounds."""
        hrtf = message.hrtf or hello.hrtf or DEFAULT_HRTF
        session = self._new_session(hello, levels, hrtf, quality, self._window, listener=message.pose, index=number)
        return NewListener(message, session, hrtf)

    def _new_session(
        self,
        hello: Hello,
        levels: FieldsByLevel,
        hrtf: str,
        quality: QualityStep,
        window: int,
        *,
        listener: Pose | None = None,
        index: int = 0,
    ) -> Session:
        host, scene = self._host, self._scene
        assert scene is not None, "a hello comes before a session"
        filters, field_filters = host.head(hrtf, levels)
        return Session(
            hello,
            levels,
            filters,
            lambda name: loaded_clip(scene.clips, host.clip_store, name),
            quality=quality,
            max_emitters=host.settings.max_emitters,
            shared_tail=host.settings.shared_tail,
            window=window,
            place=place_of(
                levels.bundle,
                scene.reverberations,
                block_size=hello.block_size,
                sample_rate=levels.default.sample_rate,
            ),
            costs=lambda bus: scene.effect_costs.get(bus, {}),
            field_filters=field_filters,
            listener=listener,
            index=index,
        )

    async def _pump(self, stream: Stream, hello: Hello, place: Place) -> Goodbye | None:
        """Read and send. Returns None if the client has gone, or else the reason to end the connection."""
        self._stream, self._place = stream, place
        self._has_resumed = True
        about(session=self._session)
        _logger.info(
            "stream opened",
            extra={"scene": hello.scene, "quality": stream.session.quality.level, "encoding": hello.encoding},
        )
        opened_s = self._time_s()
        self._host.ledger.open(stream)
        self._host.audio.open(stream)
        reading = asyncio.create_task(self._read_incoming(stream, hello))
        tasks = [reading, asyncio.create_task(self._send_outgoing()), asyncio.create_task(self._watch(stream))]
        access = self._host.access
        if access is not None and self._caller is not None:
            tasks.append(asyncio.create_task(_end_of_access(access, self._caller)))
        if hello.snapshots and self._host.seal is not None:
            tasks.append(asyncio.create_task(self._send_snapshots(stream)))
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            has_gone = any(task.result() is None for task in done)
            if has_gone and reading not in done:  # the sender noticed first; only the reader learns the close code
                await asyncio.wait({reading}, timeout=_GOODBYE_S)
            # If the client has gone, any reason to end the connection no longer matters.
            ending = None if has_gone else next(iter(done)).result()
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
            if self._may_come_back(ending):
                await self._keep(stream, place)
            return ending
        except asyncio.CancelledError:
            if self._host.readiness.drain.has_begun:
                self._parting = await self._seal(stream)
            raise
        finally:
            self._host.audio.close(stream)
            self._host.ledger.close(stream)
            self._stream = self._place = None
            self._figures = {
                "duration_s": round(self._time_s() - opened_s, 3),
                "blocks_sent": stream.audience.totals()[0]["sent"],
                "listeners": len(self._roster),
                "blocks_late": stream.blocks_late,
            }
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
            if self._receiving is not None:
                self._receiving.cancel()

    def _may_come_back(self, ending: Goodbye | None) -> bool:
        """Whether the client has neither said goodbye nor lost its stream by a fault."""
        if ending is None:
            return self._left_with not in GOODBYES
        return ending not in (_FAILED, _ENDINGS["key_revoked"])

    async def _keep(self, stream: Stream, place: Place) -> None:
        """Keep the stream for its client to resume."""
        if self._token is None:
            return
        state = await self._take_state(stream)
        if state is None:
            return
        data = state.snapshot.model_dump_json().encode()
        if len(data) > MOST_BYTES:
            return
        is_held = self._host.admission.keep(place)
        self._host.kept.close(self._token, KeptStream(data, state.plays_s, place if is_held else None))

    async def _send_snapshots(self, stream: Stream) -> Goodbye:
        while True:
            await asyncio.sleep(_SNAPSHOT_PERIOD_S)
            if (taken := await self._seal(stream)) is not None:
                self._enqueue([taken])

    async def _seal(self, stream: Stream) -> SnapshotTaken | None:
        """A sealed snapshot of the stream; None without a secret, or if it would be too long."""
        host = self._host
        state = None if host.seal is None else await self._take_state(stream)
        if state is None or host.seal is None:
            return None
        now = host.wall_s()
        data = state.snapshot.model_dump_json().encode()
        plays_at = now + state.plays_s - self._time_s()
        sealed = host.seal.close(data, plays_at=plays_at, now=now, owner=self._owner or "")
        if sealed is None:
            return None
        return SnapshotTaken(
            snapshot=sealed,
            pose_id=state.snapshot.pose_id,
            handled=state.snapshot.handled,
            expires_s=host.seal.lifetime_s,
        )

    async def _take_state(self, stream: Stream) -> StreamState | None:
        """The state of the stream after all messages that were passed on; None if its audio thread does not answer."""
        self._state = asyncio.get_running_loop().create_future()
        stream.offer(TakeSnapshot(self._session, self._handled))
        try:
            async with asyncio.timeout(_STATE_S):
                return await self._state
        except TimeoutError:
            return None
        finally:
            self._state = None

    async def _read_incoming(self, stream: Stream, hello: Hello) -> None:
        """Handle incoming messages until the client has gone."""
        if self._fast_path is not None:
            self._allow_for(stream)
            self._fast_path.listen(self._handle_at_once)
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                data = await self._next_message()
                self._is_handling = True
                await self._handle(data, stream, hello)
                self._is_handling = False

    def _handle_at_once(self, data: str | bytes) -> bool:
        """Handle a message that needs only the audio thread. Returns False, and does nothing, for any other message or
        while an earlier one is being handled."""
        if self._is_handling or self._stream is None:
            return False
        message: ClientMessage | None = None
        try:
            message = self._parse(data)
            if isinstance(message, AddEmitter | AddListener):
                return False
            self._pass_on(message, self._stream)
        except RequestError as refusal:
            self._refuse(refusal, message or data)
        self._handled += _counts(message, data)
        return True

    async def _handle(self, data: str | bytes, stream: Stream, hello: Hello) -> None:
        message: ClientMessage | None = None
        try:
            message = self._parse(data)
            if isinstance(message, AddEmitter) and message.clip is not None:
                if is_upload(message.clip):
                    await self._bring_clip(message.clip, stream)
                # Decoded here, off the event loop, so that the audio thread need not wait.
                assert self._scene is not None
                await asyncio.to_thread(load_clip, self._scene.clips, self._host.clip_store, message.clip)
            if isinstance(message, AddListener):
                await self._add_listener(message, stream, hello)
            else:
                self._pass_on(message, stream)
        except RequestError as refusal:
            self._refuse(refusal, message or data)
        self._handled += _counts(message, data)

    async def _bring_clip(self, name: str, stream: Stream) -> None:
        """Have an uploaded clip on this machine. While it comes from elsewhere, the stream goes on: blocks are
        acknowledged, and other messages wait their turn. Raises RequestError unknown_clip, store_unreachable, or
        server_busy if it takes long."""
        uploads = self._host.uploads
        if uploads is None or uploads.shared is None:
            return
        bringing = asyncio.create_task(uploads.bring(name))
        bringing.add_done_callback(_forget)
        try:
            async with asyncio.timeout(_CLIP_WAIT_S):
                while not bringing.done():
                    if len(self._held) >= _MOST_HELD:
                        await asyncio.wait({bringing})
                        break
                    if self._receiving is None:
                        self._receiving = asyncio.create_task(self._receive())
                        self._receiving.add_done_callback(_forget)
                    await asyncio.wait({bringing, self._receiving}, return_when=asyncio.FIRST_COMPLETED)
                    if self._receiving.done():
                        receiving, self._receiving = self._receiving, None
                        self._handle_early(receiving.result(), stream)
                bringing.result()
        except TimeoutError:
            coming = f"clip {name} is on its way from another machine: ask again in 1 s"
            raise RequestError("server_busy", coming, field="clip", status=503, retry_after_s=1) from None
        finally:
            bringing.cancel()

    def _handle_early(self, data: str | bytes, stream: Stream) -> None:
        """Handle a message before those that came earlier if it may, and hold it otherwise."""
        try:
            message = self._parse(data)
        except RequestError:
            self._held.append(data)
            return
        if not isinstance(message, Acknowledge | Ping):
            self._held.append(data)
            return
        try:
            self._pass_on(message, stream)
        except RequestError as refusal:
            self._refuse(refusal, message)

    async def _next_message(self) -> str | bytes:
        """The next message in the order in which they came."""
        if self._held:
            return self._held.popleft()
        if self._receiving is None:
            return await self._receive()
        receiving, self._receiving = self._receiving, None
        return await receiving

    async def _add_listener(self, message: AddListener, stream: Stream, hello: Hello) -> None:
        """Make a session for another listener, off the event loop, and hand it to the stream. Messages that come
        meanwhile wait. Raises RequestError duplicate_listener, too_many_listeners, unknown_hrtf,
        position_out_of_bounds, too_many_messages, or server_busy if it has no room."""
        host, place = self._host, self._place
        assert place is not None
        levels = stream.levels
        number = self._roster.enter(message.id)
        try:
            # guard: who comes and goes in a loop leaves no work behind without bound
            if stream.audience.departed_work >= _MOST_DEPARTED_WORK:
                problem = "the server still computes for listeners who have left: ask again in 1 s"
                raise RequestError("server_busy", problem, status=503, retry_after_s=1)
            if (refusal := host.admission.add_listener(place)) is not None:
                raise refusal.error
            try:
                if message.hrtf is not None:
                    await asyncio.to_thread(host.head, message.hrtf, levels)
                if self._fast_path is not None:
                    self._fast_path.charge(LISTENER_COST)
                make = partial(self._new_listener, message, number, hello, levels, stream.ladder.step)
                new = await host.openings.run(make, is_wanted=self._is_there)
                if new is None:
                    return
                self._widen(1)
                if not stream.offer(new):
                    self._widen(-1)
                    raise RequestError("too_many_messages", "too many messages in one block: this one was ignored")
            except RequestError:
                host.admission.remove_listener(place)
                raise
        except RequestError:
            self._roster.leave(message.id)
            raise
        if len(self._roster) > self._allowed:
            self._allow_for(stream)
        _logger.info("listener added", extra={"listener": message.id, "index": number, "hrtf": new.hrtf})

    def _allow_for(self, stream: Stream) -> None:
        """Let the client send as much as it may with its present listeners; this fills its budget up, so it happens
        once for each number of them."""
        self._allowed = len(self._roster)
        if self._fast_path is not None:
            allowed = {"emitters": self._host.settings.max_emitters, "listeners": self._allowed}
            self._fast_path.allow(Allowance.of(**allowed, sample_rate=stream.sample_rate))

    def _remove_listener(self, message: RemoveListener, place: Place) -> None:
        """Raises RequestError unknown_listener."""
        self._roster.leave(message.id)
        self._host.admission.remove_listener(place)
        _logger.info("listener removed", extra={"listener": message.id})

    def _widen(self, listeners: int) -> None:
        """Note how many blocks of so many more listeners may wait to be sent."""
        self._capacity += listeners * self._window
        if self._block_encoding is not None:
            self._block_encoding.capacity = self._capacity

    def _refuse(self, refusal: RequestError, message: ClientMessage | str | bytes) -> None:
        """Tell the client that a message was refused, as it came if it could not be read."""
        if isinstance(message, str | bytes):
            about = ids_named_by(message)
        else:
            about = emitter_of(message), listener_of(message)
        self._enqueue([Error.from_refusal(refusal, *about)])

    def _pass_on(self, message: ClientMessage, stream: Stream) -> None:
        """Answer a ping, or put the message into the stream's inbox. Raises RequestError too_many_messages, or
        server_busy for what has no room."""
        if isinstance(message, Ping):
            self._enqueue([Pong(id=message.id)])
            return
        if isinstance(message, DryPackets):
            assert self._live_decoders is not None
            message = self._live_decoders.decode(message)
        elif not self._is_confirmed and isinstance(message, Acknowledge) and self._token is not None:
            self._is_confirmed = True
            self._host.kept.confirm(self._token)
        if not stream.offer(self._admitted(message, stream)):
            raise RequestError("too_many_messages", "too many messages in one block: this one was ignored")

    def _admitted(self, message: ClientMessage, stream: Stream) -> ClientMessage | ChosenSteps:
        """The message, or what to do in its place, if there is room for what it asks for. Raises RequestError
        server_busy if there is not, and unknown_level."""
        place, admission = self._place, self._host.admission
        assert place is not None
        refusal: Refusal | int | None = None
        match message:
            case AddEmitter():
                refusal = admission.add_emitter(place, is_live=message.live)
            case RemoveEmitter():
                admission.remove_emitter(place)
                if self._live_decoders is not None:
                    self._live_decoders.forget(message.id)
            case RemoveListener():
                self._remove_listener(message, place)
            case SetEffects() if any(message.effects.values()) or message.output not in {None, "mono"}:
                refusal = admission.add_effects(place)
            case SetLevel():
                steps = stream.steps(message.level)
                refusal = admission.choose(place, steps)
                if isinstance(refusal, int):
                    return ChosenSteps(message.level, steps, refusal)
        if isinstance(refusal, Refusal):
            raise refusal.error
        return message

    async def _receive(self) -> str | bytes:
        event = await self._websocket.receive()
        if event["type"] == "websocket.disconnect":
            code = self._left_with = event.get("code", NORMAL)
            raise WebSocketDisconnect(code)
        text: str | None = event.get("text")
        return event["bytes"] if text is None else text

    def _parse(self, data: str | bytes) -> ClientMessage:
        limit = self._host.settings.max_message_bytes
        size = len(data.encode() if isinstance(data, str) else data)
        if size > limit:
            raise RequestError("message_too_large", f"a message has at most {limit} bytes, not {size}", status=413)
        return parse_client_message(data)

    def _deliver(self, outgoing: list[Outgoing]) -> None:
        """Send the audio thread's output, once it is encoded."""
        if self._state is not None:
            outgoing = list(self._without_state(outgoing))
        if self._block_encoding is None:
            self._send_or_queue(outgoing)
        elif not self._block_encoding.put(outgoing):
            self._end(_TOO_SLOW)

    def _send_encoded(self, outgoing: list[Outgoing]) -> None:
        if self._stream is not None and self._block_encoding is not None:
            self._stream.encoding_load = self._block_encoding.load
        self._send_or_queue(outgoing)

    def _send_or_queue(self, outgoing: list[Outgoing]) -> None:
        """Send output: blocks at once if there is a fast path and nothing waits to be sent."""
        if self._stream is None or self._place is None:
            return  # rendered before the audio thread knew that the connection ends
        for each in outgoing:
            if isinstance(each, EmitterEnded) and each.removed:
                self._host.admission.remove_emitter(self._place)
        if gone := {each.index for each in outgoing if isinstance(each, ListenerRemoved)}:
            outgoing = self._let_go(gone, outgoing)
        blocks: list[bytes] = []
        if self._fast_path is not None and not (self._outgoing or self._is_sending):
            now_s = self._time_s()
            blocks = [self._serialize(block, now_s) for block in _first_blocks(outgoing)]
            if blocks and not self._fast_path.write(blocks):
                blocks = []
        if len(blocks) < len(outgoing):
            self._enqueue(outgoing[len(blocks) :])

    def _let_go(self, gone: Set[int], outgoing: Sequence[Outgoing]) -> list[Outgoing]:
        """The output less the blocks of listeners who have left. Nor are those sent that wait, so that the others do
        not lack the room."""

        def is_wanted(each: Outgoing) -> bool:
            return not (isinstance(each, TimedBlock) and each.block.listener in gone)

        self._outgoing = deque(filter(is_wanted, self._outgoing))
        self._widen(-len(gone))
        return list(filter(is_wanted, outgoing))

    def _without_state(self, outgoing: list[Outgoing]) -> Iterator[Outgoing]:
        """The output less the state that was asked for, which is for this connection itself."""
        for each in outgoing:
            if not isinstance(each, StreamState):
                yield each
            elif self._state is not None and not self._state.done():
                self._state.set_result(each)

    def _end(self, goodbye: Goodbye) -> None:
        """End the connection soon, for the first reason given."""
        self._goodbye = self._goodbye or goodbye
        self._is_ending.set()

    def _enqueue(self, outgoing: Sequence[Outgoing]) -> None:
        """Queue messages for the sender. If there is no room, they are dropped and the connection ends."""
        if len(self._outgoing) + len(outgoing) > self._capacity:
            self._end(_TOO_SLOW)
            return
        self._outgoing += outgoing
        self._has_outgoing.set()

    async def _watch(self, stream: Stream) -> Goodbye:
        """Return once the client reads too slowly, acknowledges nothing, or has another connection. This is separate
        from the sender, which may itself wait for a client that does not read."""
        patience_s = left_s = self._host.settings.stall_timeout_s
        while left_s > 0:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left_s):
                    await self._is_ending.wait()
                    assert self._goodbye is not None
                    return self._goodbye
            left_s = patience_s - stream.stalled_s
        message = f"no block was acknowledged for {patience_s:g} s, and there is no room for more"
        return Goodbye(POLICY_VIOLATION, Error(code="stalled", message=message))

    async def _send_outgoing(self) -> Goodbye | None:
        """Send queued messages. Returns None if the client has gone, or the reason if the stream has failed."""
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                await self._has_outgoing.wait()
                self._has_outgoing.clear()
                self._is_sending = True
                while self._outgoing:
                    match self._outgoing.popleft():
                        case TimedBlock() as timed:
                            await self._websocket.send_bytes(self._serialize(timed, self._time_s()))
                        case StreamFailed():
                            return _FAILED
                        case StreamState():  # it came too late
                            continue
                        case message:
                            await self._send_message(message)
                self._is_sending = False
        return None

    def _serialize(self, timed: TimedBlock, now_s: float) -> bytes:
        block, stream = timed.block, self._stream
        if stream is not None and stream.note_sent(timed.deadline_s, now_s) and not block.is_late:
            stream.blocks_late += 1
            block.is_late = True
        return block.serialize(self._encoding) if timed.packets is None else block.serialize_packets(timed.packets)

    async def _send_message(self, message: ServerMessage) -> None:
        await self._websocket.send_text(message.serialize())
