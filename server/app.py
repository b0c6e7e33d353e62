"""The ASGI application: loads scenes, starts the audio thread, warms up, serves."""

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
from fastapi import FastAPI
from starlette.staticfiles import StaticFiles

from server.answers import Answers
from server.audio_thread import AudioThread
from server.catalogue import load_fields, open_clips, playable_clips
from server.field.field import AcousticField
from server.problems import install_problems
from server.rendering.renderer import Renderer
from server.routes import api, health
from server.settings import Settings
from server.streaming import StreamHost

WEB = Path(__file__).parent / "web"

_logger = logging.getLogger(__name__)


def create_app(settings: Settings, *, fields: Mapping[str, AcousticField] | None = None) -> FastAPI:
    """`fields` by scene id, where the caller has loaded them already to see their errors first.

    Otherwise they are loaded at start-up, which raises BundleError for a damaged bundle.
    """

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[dict[str, StreamHost]]:
        loaded = await asyncio.to_thread(load_fields, settings.bundles) if fields is None else fields
        with ThreadPoolExecutor(settings.ir_workers, "nafir-ir") as workers:
            audio = AudioThread(asyncio.get_running_loop().call_soon_threadsafe, workers)
            host = StreamHost(
                fields=loaded,
                clips=open_clips(loaded, settings.clips),
                audio=audio,
                settings=settings,
                # One more than there are IR workers: a map must not hold up an IR.
                answers=Answers(workers=settings.ir_workers + 1, waiting=settings.max_waiting_requests),
            )
            audio.start()
            warming = asyncio.create_task(_become_ready(host))
            try:
                yield {"host": host}
            finally:
                warming.cancel()
                await asyncio.to_thread(audio.stop)

    app = FastAPI(
        title="Nafir",
        version=version("nafir"),
        description="Renders how a place sounds, in real time.",
        lifespan=lifespan,
        docs_url="/docs",
        redoc_url=None,
    )
    install_problems(app)
    app.include_router(health)
    app.include_router(api)
    app.mount("/", StaticFiles(directory=WEB, html=True, check_dir=False), name="web")
    return app


async def _become_ready(host: StreamHost) -> None:
    try:
        await asyncio.to_thread(_warm_up, host)
    except Exception:  # whatever it is, the server stays up, and not ready, for an operator to look at
        _logger.exception("warm-up failed")
        return
    host.is_ready = True
    _logger.info("ready: %s", ", ".join(host.fields))


def _warm_up(host: StreamHost) -> None:
    """Do once what every stream does, so that the first one does not pay for it: decode clips, an IR, some blocks."""
    for scene, field in host.fields.items():
        clips = playable_clips(host.clips[scene])
        start = field.bundle.manifest.start
        ir = field.impulse_responses([start.listener], [start.emitter], [0.0])[0]
        renderer = Renderer(block_size=256, ir_samples=field.ir_samples, channels=field.channels, max_emitters=1)
        samples = host.clips[scene].load(clips[0].name) if clips else np.ones(field.sample_rate, np.float32)
        renderer.add_emitter("warm-up", samples)
        for _ in range(8):
            renderer.set_ir("warm-up", renderer.prepare(ir))
            renderer.process()
