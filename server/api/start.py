"""What `nafir serve` loads before it serves."""

import contextlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from server.api.catalogue import load_hrtfs, load_scenes
from server.api.first_start import CompilingProcess
from server.api.process_peers import ProcessPeers
from server.api.settings import Settings, usable_cores
from server.core.errors import NafirError
from server.runtime.drain import Drain
from server.scene.bundle import Bundle, bundled_scenes

if TYPE_CHECKING:
    from fastapi import FastAPI


@contextlib.contextmanager
def loaded_app(
    settings: Settings, drain: Drain, *, peers: ProcessPeers | None = None
) -> Iterator[tuple["FastAPI", tuple[str, ...]]]:
    """The application with its scenes, and their names. Raises NafirError if there is none, or if something cannot be
    loaded."""
    with CompilingProcess() as compiler:
        compiler.begin(map(Bundle.load, bundled_scenes()), cores=usable_cores())
        with ThreadPoolExecutor(1, "nafir-scenes") as loading:
            loaded = loading.submit(load_scenes, settings.bundles, keys=settings.read_bundle_keys())
            # Meanwhile: importing these takes as long as finding the ways round the edges of a level.
            import server.api.serving  # noqa: F401
            from server.api.app import create_app
        scenes = loaded.result()
        if not scenes:
            raise NafirError("there is no scene to serve: give one with --bundle FOLDER")
        hrtfs = load_hrtfs(settings.hrtfs, scenes)
        yield (
            create_app(settings, scenes=scenes, hrtfs=hrtfs, drain=drain, compiler=compiler, peers=peers),
            tuple(scenes),
        )
