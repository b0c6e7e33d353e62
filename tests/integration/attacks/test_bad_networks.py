"""Listeners whose networks are slow, lossy, cut or half-open, beside somebody who listens. Their client is
`nafir_client`, which has no code of the server."""

import asyncio
from itertools import pairwise

import numpy as np
import pytest

import nafir_client
from tests.integration.lossy_proxy import LossyProxy

pytestmark = pytest.mark.attack

LISTENERS = 6
ATTACK_S = 12.0
CUT_AFTER_S = 3.0, 6.0
DARK_AFTER_S = 2.0
"""The client notices after six seconds of silence."""
_POSES_PER_S = 30.0


class Heard:
    """What one listener heard: the sample clocks of its blocks, and how loud each was."""

    def __init__(self):
        self.clocks, self.frames, self.peaks = [], [], []
        self.reconnections = self.resumptions = 0

    async def listen(self, address, until_s):
        loop = asyncio.get_running_loop()
        async with nafir_client.connect(f"ws://{address}", scene="apartment") as stream:
            walking = asyncio.create_task(self._walk(stream))
            await stream.add_emitter(clip="man-reading", position=(3.0, 3.0, 1.5))
            async for block in stream:
                self.clocks.append(block.sample_clock)
                self.frames.append(len(block.samples))
                self.peaks.append(float(np.abs(block.samples).max()))
                if loop.time() > until_s:
                    break
            walking.cancel()
            counts = stream.statistics
            self.reconnections, self.resumptions = counts.reconnections, counts.resumptions
        return self

    async def _walk(self, stream):
        for step in range(10_000):
            angle = step / 40
            await stream.move_listener((2 + 0.5 * np.cos(angle), 2 + 0.5 * np.sin(angle), 1.6), yaw=angle)
            await asyncio.sleep(1 / _POSES_PER_S)


def test_bad_networks_harm_only_those_who_have_them_and_their_streams_go_on(address, endures):
    def attack():
        async def listen(lossy, silent):
            loop = asyncio.get_running_loop()
            until_s = loop.time() + ATTACK_S
            loop.call_later(DARK_AFTER_S, silent.go_dark)
            for after_s in CUT_AFTER_S:
                loop.call_later(after_s, loop.run_in_executor, None, lossy.cut)
            networks = [lossy] * LISTENERS + [silent] * 2
            return await asyncio.gather(*(Heard().listen(network.address, until_s) for network in networks))

        with LossyProxy(address, delay_s=0.2, loss=0.15).running() as lossy, LossyProxy(address).running() as silent:
            return asyncio.run(listen(lossy, silent))

    heard = endures(attack)
    assert all(each.reconnections >= len(CUT_AFTER_S) for each in heard[:LISTENERS])
    assert all(each.reconnections >= 1 for each in heard[LISTENERS:])
    for each in heard:
        assert each.resumptions == each.reconnections
        # The clock of one stream, over all connections: nothing comes twice, and what is missing was silent.
        ends = np.add(each.clocks, each.frames)
        assert all(end <= begin for end, (_, begin) in zip(ends, pairwise(each.clocks), strict=False))
        assert max(each.peaks[-len(each.peaks) // 6 :]) > 1e-3, "what was acknowledged is still heard"
