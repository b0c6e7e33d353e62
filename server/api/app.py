"""The ASGI application. It loads scenes, starts the audio engine, warms up, and serves."""

import asyncio
import dataclasses
import logging
from collections.abc import AsyncIterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import AbstractContextManager, asynccontextmanager, nullcontext
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

from fastapi import FastAPI, Response
from starlette.types import Scope

from server.api.access import Access
from server.api.access_gate import AccessGate, page_paths
from server.api.bundle_folder import BundleFolder
from server.api.bundle_store import BundleStore
from server.api.catalogue import load_hrtfs, load_scenes, open_clips, playable_clips
from server.api.compression import Compression
from server.api.connection import MeasuredScene, StreamHost
from server.api.connection_limits import HEALTH_PATHS, LIVENESS_PATH
from server.api.cross_site import CrossSiteGate, SitePolicy
from server.api.drain_gate import DrainGate
from server.api.first_start import CompilingProcess, tell_while_compiling
from server.api.http_durations import HttpDurations
from server.api.openapi import install_openapi
from server.api.page_files import PageFiles
from server.api.problems import install_problems
from server.api.process_peers import ProcessPeers
from server.api.rate_limits import RateGate, RateLimits, address_of, key_of
from server.api.request_log import RefusedRequests, RequestLog
from server.api.response_cache import ResponseCache
from server.api.routes import api, documents, health
from server.api.settings import Settings, usable_cores
from server.api.strict_requests import StrictRequests
from server.api.uploads import Uploads
from server.assets.clip_store import ClipStore
from server.assets.clips import Clip
from server.assets.hrtfs import DEFAULT_HRTF, HrtfLibrary
from server.assets.shared_clips import SharedClips
from server.assets.upload_decoder import DecodingLimits
from server.core.entity_tags import fingerprint
from server.core.stores import Store
from server.field.fields_by_level import FieldsByLevel
from server.planning.effect_costs import measure_costs
from server.planning.places import place_of_field
from server.protocol.client_messages import AUTO, PROTOCOL, AddEmitter, BlockSize, Hello, ListenerPose
from server.rendering.head_decoder import ORDERS, HeadDecoder
from server.rendering.warm_up import compile_rendering, warm_up
from server.responses.ir_request import compute_irs
from server.runtime.drain import Drain
from server.runtime.memory import collect_as_usual, collect_rarely
from server.runtime.own_thread import run_in_own_thread
from server.runtime.pace import CpuBudget
from server.runtime.priority import DutyCycle, become_background, become_prompt
from server.runtime.readiness import Readiness
from server.runtime.thread_pool import ThreadPool
from server.runtime.thread_watch import ThreadWatch
from server.runtime.traces import begin_traces
from server.runtime.workers import Workers
from server.scene.signatures import BundleKeys
from server.streaming.audio_engine import AudioEngine
from server.streaming.calibration import calibrate
from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.quality_steps import Offer
from server.streaming.render_costs import measure_rendering
from server.streaming.session import Session

_CALIBRATION_POSES = 3
_COSTS_AFTER_S = 5.0
_COSTS_SHARE = 0.05
"""Share of a core that the measurement of effects' costs may take while there are streams."""
_ENCODERS = 2
"""Threads that encode in Opus. One is enough for some 250 streams of two channels, or 30 of third-order ambisonics."""
_ENCODER_PATIENCE_S = 10.0
"""Time for the blocks of a tick of one stream, which take milliseconds to encode."""
_ENCODER_STOP_S = 1.0
_PAGE_ORDER = ORDERS[0]
"""The order of the ambisonics that the page asks for."""
WEB = Path(__file__).parents[1] / "web"

_OPEN_TO_ALL = (
    "WARNING: this server asks for no key, and at %s others can reach it: anybody may use it. Make a key with "
    "`nafir keys create` and name its file in NAFIR_KEYS_FILE. NAFIR_REQUIRE_AUTH=true refuses to start without"
)

_logger = logging.getLogger(__name__)


def create_app(
    settings: Settings,
    *,
    scenes: Mapping[str, FieldsByLevel] | None = None,
    hrtfs: HrtfLibrary | None = None,
    drain: Drain | None = None,
    compiler: CompilingProcess | None = None,
    peers: ProcessPeers | None = None,
) -> FastAPI:
    """The application. A caller that wants to report loading errors first passes the loaded `scenes`, by id, and
    `hrtfs`. `drain` lets the caller begin the shutdown. `compiler` may have begun to compile already. `peers`
    are the processes of which this is one.

    Raises NafirError for files of keys that cannot be used, for traces without the extra `otel`, and for a store of
    bundles or clips without the extra `store`. Without `scenes` or `hrtfs` they are loaded at start-up, which raises
    BundleError for a damaged bundle and HrtfError for a damaged HRTF file.
    """
    drain = Drain(settings.drain_s) if drain is None else drain
    end_traces = None if settings.traces_url is None else begin_traces(settings.traces_url)
    store = None if settings.bundle_url is None else BundleStore(settings.bundle_url)
    clips = None if settings.clips_url is None else Store(settings.clips_url, "clips_url")
    access = Access.of(settings, own_key=None if peers is None else peers.key)
    refused, durations = RefusedRequests(), HttpDurations()
    if access is None and not settings.is_loopback and (peers is None or peers.number == 0):
        _logger.warning(_OPEN_TO_ALL, settings.host)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[dict[str, StreamHost]]:
        keys = settings.read_bundle_keys()
        load = partial(load_scenes, settings.bundles, keys=keys)
        loaded = dict(await asyncio.to_thread(load) if scenes is None else scenes)
        with (
            store or nullcontext(),
            _folder_of_clips(settings) as clips_folder,
            Workers(settings.ir_workers, "nafir-ir", initializer=become_background) as workers,
            ResponseCache(
                # One more than there are IR workers. Maps never take the last one, so that cheap requests have it.
                workers=settings.ir_workers + 1,
                waiting=settings.max_waiting_requests,
                is_urgent=lambda: workers.are_busy,
                budget=CpuBudget(lambda: host.admission.background_share),
                on_refusal=lambda: host.admission.count_request(),  # noqa: PLW0108  the host is made later
            ) as responses,
            CompilingProcess() if compiler is None else compiler as compiling,
        ):
            folder = _watched_bundles(settings, store, dict(loaded), keys)
            if folder is not None:
                loaded |= (await asyncio.to_thread(folder.look, is_first=True)).loaded
            heads = await asyncio.to_thread(load_hrtfs, settings.hrtfs, loaded) if hrtfs is None else hrtfs
            audio = AudioEngine(
                asyncio.get_running_loop().call_soon_threadsafe,
                workers,
                threads=settings.audio_threads,
                is_real_time=settings.realtime,
                thresholds=dataclasses.replace(THRESHOLDS, ir_share=settings.ir_share),
            )
            encoders = ThreadPool(
                min(_ENCODERS, settings.audio_threads), "nafir-encoder", patience_s=_ENCODER_PATIENCE_S
            )
            host = StreamHost(
                scenes=loaded,
                clips=open_clips(loaded, settings.clips),
                hrtfs=heads,
                audio=audio,
                settings=settings,
                responses=responses,
                readiness=Readiness(drain, ThreadWatch((audio, workers.pool, workers.ways, responses.pool, encoders))),
                encoders=encoders,
                uploads=_uploads(settings, clips_folder, clips),
                peers=peers,
                access=access,
                refused_requests=refused,
                http_durations=durations,
                stores={name: each.calls for name, each in (("bundles", store), ("clips", clips)) if each is not None},
            )
            if settings.realtime:
                become_prompt()
            audio.start()
            tasks = [
                asyncio.create_task(_become_ready(host, compiling, folder)),
                asyncio.create_task(host.readiness.watch.run()),
                asyncio.create_task(host.admission.run()),
            ]
            if access is not None:
                tasks.append(asyncio.create_task(access.watch()))
            if host.uploads is not None:
                tasks.append(asyncio.create_task(host.uploads.follow()))
            try:
                yield {"host": host}
            finally:
                drain.begin()
                for task in tasks:
                    task.cancel()
                await asyncio.to_thread(audio.stop)
                await asyncio.to_thread(encoders.stop, _ENCODER_STOP_S)
                if end_traces is not None:
                    await asyncio.to_thread(end_traces)
                collect_as_usual()

    app = FastAPI(
        title="Nafir",
        version=version("nafir"),
        description="Renders how a place sounds, in real time. Live streams are described at /asyncapi.json.",
        lifespan=lifespan,
        openapi_url=None,  # `install_openapi` answers sooner
        docs_url=None,  # the page has both, without scripts from elsewhere
        redoc_url=None,
    )
    app.add_middleware(DrainGate, drain=drain)
    install_problems(app)
    app.include_router(health)
    app.include_router(documents)
    app.include_router(api)
    install_openapi(app, max_poses=settings.max_poses, is_protected=access is not None)
    app.add_middleware(Compression)
    app.add_middleware(StrictRequests, routes=app.router.routes, closed=_turn_away)
    rate_limits = RateLimits.of(settings)
    # Where readiness needs a key, keys could be guessed there.
    open_paths = HEALTH_PATHS if access is None else (LIVENESS_PATH,)
    if access is not None:
        app.add_middleware(RateGate, limits=rate_limits, actor=key_of, open_paths=open_paths)
        app.add_middleware(AccessGate, access=access, page=page_paths(WEB) if settings.page else frozenset())
    app.add_middleware(RateGate, limits=rate_limits, actor=address_of, open_paths=open_paths)
    app.add_middleware(CrossSiteGate, policy=SitePolicy.of(settings))  # outside the others: gives refusals CORS headers
    app.add_middleware(RequestLog, routes=app.router.routes, refused=refused, durations=durations)
    if settings.page:
        # With a key that the browser adds, a page of another site could lay this one under its own and have it clicked.
        framed_by = None if access is None else settings.allowed_origins
        app.mount("/", PageFiles(framed_by=framed_by, directory=WEB, html=True, check_dir=False), name="web")
    return app


def _watched_bundles(
    settings: Settings, store: BundleStore | None, others: Mapping[str, FieldsByLevel], keys: BundleKeys | None
) -> BundleFolder | None:
    if store is not None:
        return BundleFolder(store.copies, others, keys=keys, fetch=store.fetch)
    return None if settings.bundle_folder is None else BundleFolder(settings.bundle_folder, others, keys=keys)


def _folder_of_clips(settings: Settings) -> AbstractContextManager[str | Path | None]:
    """The folder for uploaded clips, or for copies of those in a store; None if there are no uploads."""
    if settings.clips_url is not None and settings.clips_folder is None:
        return TemporaryDirectory(prefix="nafir-clips-", ignore_cleanup_errors=True)
    return nullcontext(settings.clips_folder)


def _uploads(settings: Settings, folder: str | Path | None, store: Store | None) -> Uploads | None:
    if folder is None:
        return None
    quota_bytes, expires_s = settings.clips_quota_bytes, settings.clips_expire_s
    # A folder of its own for each store: clips that were uploaded before there was one stay as they are.
    path = Path(folder) if store is None else Path(folder) / f"copies-{store.digest}"
    clips = ClipStore(path, quota_bytes=quota_bytes, expires_s=expires_s)
    shared = None if store is None else SharedClips(clips, store, quota_bytes=quota_bytes, expires_s=expires_s)
    limits = DecodingLimits(settings.max_clip_s)
    return Uploads(clips, max_bytes=settings.max_clip_bytes, limits=limits, shared=shared)


def _turn_away(scope: Scope) -> Response | None:
    host: StreamHost = scope["state"]["host"]
    return host.turn_away()


async def _become_ready(host: StreamHost, compiler: CompilingProcess, folder: BundleFolder | None) -> None:
    progress = asyncio.create_task(tell_while_compiling())
    try:
        await run_in_own_thread(partial(_warm_up, host, compiler, folder), "nafir-warm-up")
    except Exception:  # the server stays up but not ready, so that an operator can look at it
        _logger.exception("warm-up failed")
        host.readiness.warm_up = "failed"
        return
    finally:
        progress.cancel()
    collect_rarely()
    host.readiness.warm_up = "done"
    _logger.info("ready: %s", ", ".join(host.scenes))
    has_changed = asyncio.Event()
    has_changed.set()
    async with asyncio.TaskGroup() as group:
        group.create_task(_keep_prepared(host, has_changed))
        if folder is not None:
            host.refused_bundles = folder.refused
            group.create_task(_follow(host, folder, has_changed))


async def _follow(host: StreamHost, folder: BundleFolder, has_changed: asyncio.Event) -> None:
    """Offer what the folder of bundles has, as it changes, and say that it `has_changed`."""
    while True:
        await asyncio.sleep(host.settings.bundle_folder_s)
        try:
            changes = await run_in_own_thread(folder.look, "nafir-bundles")
        except Exception:  # the scenes that there are go on
            _logger.exception("the folder of bundles could not be looked at")
            continue
        for scene in changes.gone:
            host.drop(scene)
            _logger.info("dropped: %s", scene)
        for scene, levels in changes.loaded.items():
            try:
                _offer(host, await run_in_own_thread(partial(_prepared, host, levels), "nafir-bundles"))
            except Exception:  # its field computes nothing of use; other scenes go on, and so does the one in its place
                folder.refuse(levels.bundle.folder)
                _logger.exception("bundle left out: %s", levels.bundle.folder)
            else:
                _logger.info("loaded: %s, from %s", scene, levels.bundle.folder)
        host.refused_bundles = folder.refused
        if changes:
            has_changed.set()


async def _keep_prepared(host: StreamHost, has_changed: asyncio.Event) -> None:
    """Prepare the rest at the start and whenever scenes have changed since it was last begun, one time after the
    other."""
    while True:
        await has_changed.wait()
        has_changed.clear()
        await _prepare_the_rest(host)


async def _prepare_the_rest(host: StreamHost) -> None:
    """Measure and design what nothing waits for: clients that already wait are served first."""
    await asyncio.sleep(_COSTS_AFTER_S)
    duty_cycle = DutyCycle(_COSTS_SHARE, is_idle=lambda: host.streams == 0)
    later = (
        (_measure_effects, "nafir-costs", "what effects cost could not be measured: plans do not say"),
        (_prepare_decoders, "nafir-decoders", "decoders of heads are not prepared: the first to need one waits for it"),
    )
    try:
        for work, thread, failure in later:
            try:
                await run_in_own_thread(partial(work, host, duty_cycle), thread)
            except Exception:  # the server serves without either
                _logger.exception(failure)
    finally:
        duty_cycle.call_off()


def _prepare_decoders(host: StreamHost, duty_cycle: DutyCycle) -> None:
    """Design the decoders by which each head hears buses, and pages the reverberation of scenes that know directions.
    Without this the first stream or page to need one would wait for a second."""
    become_background()
    for levels in tuple(host.scenes.values()):
        orders = {*levels.buses}
        if levels.bundle.manifest.fields and levels.knows_directions:
            orders.add(_PAGE_ORDER)
        for head in host.hrtfs.names:
            for order in sorted(orders):
                try:
                    HeadDecoder.of(host.hrtfs.filters(head, levels.own_rate), order, rest=duty_cycle.rest)
                except CancelledError:  # the server shuts down
                    return


def _measure_effects(host: StreamHost, duty_cycle: DutyCycle) -> None:
    """Measure what effects cost on this host. Plans have no costs until then."""
    become_background()
    for scene, levels in tuple(host.scenes.items()):
        if scene in host.effect_costs:
            continue
        try:
            costs = {bus: measure_costs(field, rest=duty_cycle.rest) for bus, field in levels.by_bus.items()}
            host.effect_costs[scene] = costs
        except CancelledError:  # the server shuts down
            return


def _warm_up(host: StreamHost, compiler: CompilingProcess, folder: BundleFolder | None) -> None:
    """Decode clips, compute responses and render once, so that the first stream does not have to wait for it. Also
    measure how long this host takes for a response of each level. A scene of the `folder` that fails is left out, as
    one that comes later would be."""
    compiler.begin((levels.bundle for levels in host.scenes.values()), cores=usable_cores())
    with ThreadPoolExecutor(1, "nafir-clips") as decoding:
        playable = decoding.map(playable_clips, host.clips.values())
        compile_rendering()
        compiler.wait()  # all else is on disk then
        warm_up(get_args(BlockSize))
        clips_of = dict(zip(host.clips, playable, strict=True))  # before times are measured
    for scene, levels in tuple(host.scenes.items()):
        clips = clips_of[scene]
        try:
            _rehearse(host, levels, clips)
        except Exception:  # its field computes nothing of use
            if folder is None or not folder.has(levels):
                raise
            folder.refuse(levels.bundle.folder)
            _logger.exception("bundle left out: %s", levels.bundle.folder)
            host.drop(scene)
            if (replaced := folder.replaced(scene)) is not None:
                _rehearse(host, replaced, clips)
    fingerprint()


def _rehearse(host: StreamHost, levels: FieldsByLevel, clips: Sequence[Clip]) -> None:
    """Offer a scene, with all that its first stream would have to wait for."""
    _offer(host, _measured(host, levels))
    if levels.knows_directions:
        host.measure(levels.bundle.id, levels.with_directions(), _PAGE_ORDER)
    _play(host, levels, clips[0].name if clips else None)


def _measured(host: StreamHost, levels: FieldsByLevel) -> MeasuredScene:
    """A scene with how long this host takes for a response of each level, and for rendering."""
    filters = host.hrtfs.filters(DEFAULT_HRTF, levels.own_rate)
    return MeasuredScene(
        levels,
        clips=next(iter(host.clips.values())).at_rate(levels.own_rate),
        place=place_of_field(levels.default),
        offer=Offer(
            tuple(levels[name].level for name in levels.names), calibrate(levels, filters, poses=_CALIBRATION_POSES)
        ),
        render_costs=measure_rendering(levels, filters),
    )


def _prepared(host: StreamHost, levels: FieldsByLevel) -> MeasuredScene:
    """The same for a scene that comes while streams are served."""
    become_background()
    return _measured(host, levels)


def _offer(host: StreamHost, scene: MeasuredScene) -> None:
    """Offer a scene, and let admission know the cheapest stream of it."""
    host.take(scene)
    hello = Hello(protocol=PROTOCOL, scene=scene.levels.bundle.id)
    *_, cheapest = scene.offer.steps(AUTO, block_s=hello.block_size / scene.levels.own_rate)
    if (kind := host.kind_of(hello, scene.levels)) is not None:
        host.admission.offer(kind, cheapest)


def _play(host: StreamHost, levels: FieldsByLevel, clip: str | None) -> None:
    """Render some blocks of a scene."""
    hello = Hello(protocol=PROTOCOL, scene=levels.bundle.id)
    best = host.offers[hello.scene].steps(AUTO, block_s=hello.block_size / levels.own_rate)[0]
    filters = host.hrtfs.filters(DEFAULT_HRTF, levels.own_rate)
    session = Session(hello, levels, filters, host.clips[hello.scene].load, quality=best, window=100)
    start = levels.bundle.manifest.start
    session.receive(AddEmitter(id="warm-up", clip=clip, live=clip is None, position=start.emitter))
    for turn in range(1, 9):
        session.receive(ListenerPose(pose_id=turn, position=start.listener, yaw=0.1 * turn))
        if (request := session.take_request()) is not None:
            session.accept(compute_irs(levels, request, session.renderer))
        session.render_block()
