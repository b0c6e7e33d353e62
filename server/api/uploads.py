"""Uploads of clips: the body of a request becomes a stored clip, in bounded memory and time.

The body goes to disk as it comes. Then it is decoded in a process of its own, one upload at a time, and stored: in the
folder of clips, or in a store that several machines share. Whatever ends an upload before that, its files are removed.
"""

import asyncio
import logging
from collections.abc import AsyncIterator
from typing import Final

from server.assets.clip_store import ClipStore, storing
from server.assets.clips import Clip
from server.assets.shared_clips import SharedClips
from server.assets.upload_decoder import DecodingLimits, decode_apart
from server.core.errors import RequestError

MOST_AT_ONCE: Final = 8
"""Uploads that arrive or wait for the decoder at one time."""
_PIECE_BYTES = 256 * 1024
_RETRY_AFTER_S = 5
_logger = logging.getLogger(__name__)


class Uploads:
    """Receives clips for a `store`, of at most `max_bytes` each and within `limits`, and knows those that there are. If
    they are `shared`, the `store` has copies of them. It belongs to the event loop.

    Where clips are shared, every method raises RequestError store_unreachable too.
    """

    def __init__(
        self, store: ClipStore, *, max_bytes: int, limits: DecodingLimits, shared: SharedClips | None = None
    ) -> None:
        self.store = store
        self.shared = shared
        self._max_bytes = max_bytes
        self._limits = limits
        self._decoder = asyncio.Lock()
        self._arriving = 0

    async def receive(self, body: AsyncIterator[bytes], title: str) -> tuple[Clip, bool]:
        """Store what a request sends; return the clip and whether it is new.

        Raises RequestError: server_busy, body_too_large, undecodable_clip, clip_too_long, clips_full, storage_failed.
        """
        if self._arriving >= MOST_AT_ONCE:
            busy = f"{MOST_AT_ONCE} clips are being uploaded: try again later"
            raise RequestError("server_busy", busy, status=503, retry_after_s=_RETRY_AFTER_S)
        if self.shared is not None:
            self.shared.require()
        self._arriving += 1
        try:
            incoming = await asyncio.to_thread(self.store.receive)
            try:
                async for piece in _in_pieces(body):
                    if incoming.size_bytes + len(piece) > self._max_bytes:
                        problem = f"a clip has at most {self._max_bytes} bytes"
                        raise RequestError("body_too_large", problem, status=413)
                    await asyncio.to_thread(incoming.write, piece)
                with storing():
                    incoming.close()
                async with self._decoder:
                    decoded = await decode_apart(incoming.path, incoming.target, self._limits)
                if decoded.warning:
                    _logger.info("an uploaded clip: %s", decoded.warning)
                if self.shared is not None:
                    return await self.shared.keep(incoming, title, decoded.duration_s)
                return await asyncio.to_thread(self.store.keep, incoming, title, decoded.duration_s)
            finally:
                incoming.discard()
        finally:
            self._arriving -= 1

    async def clips(self) -> list[Clip]:
        """Descriptions of all uploaded clips, by name."""
        if self.shared is not None:
            return await self.shared.clips()
        return await asyncio.to_thread(self.store.clips)

    async def describe(self, name: str) -> Clip:
        """Raises UnknownClipError."""
        if self.shared is not None:
            return await self.shared.describe(name)
        return await asyncio.to_thread(self.store.describe, name)

    async def bring(self, name: str) -> None:
        """Have a clip on this machine. Raises UnknownClipError, and RequestError storage_failed."""
        if self.shared is not None:
            await self.shared.bring(name)

    async def remove(self, name: str) -> None:
        """Remove a clip; what plays it goes on. Raises UnknownClipError, and RequestError storage_failed."""
        if self.shared is not None:
            await self.shared.remove(name)
        else:
            await asyncio.to_thread(self.store.remove, name)

    async def follow(self) -> None:
        """Follow what other machines upload and delete, for ever."""
        if self.shared is not None:
            await self.shared.run()


async def _in_pieces(body: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The body in pieces that are worth a write each."""
    waiting = bytearray()
    async for data in body:
        waiting += data
        if len(waiting) >= _PIECE_BYTES:
            yield bytes(waiting)
            waiting.clear()
    if waiting:
        yield bytes(waiting)
