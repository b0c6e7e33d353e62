"""Two players at one screen: each hears the scene from where they stand, in one stream.

    pip install './client_examples/python[record]'
    python split_screen.py ws://127.0.0.1:8000 apartment 5

Stores so many seconds of both: `one.wav` from where the scene begins, `two.wav` from beside the clip.
"""

import asyncio
import sys

import nafir_client
from nafir_client.recording import record, write_wav


async def play(url: str, scene: str, seconds: str) -> None:
    async with nafir_client.connect(url, scene=scene, listeners=2) as one:
        x, y, z = one.scene.emitter.position
        two = await one.add_listener((x - 0.5, y, z))
        clip = await one.add_emitter(clip="woman-reading")
        frames = round(float(seconds) * one.sample_rate)
        heard = await asyncio.gather(*(record(each, frames, start_clock=clip.start_clock) for each in (one, two)))
    for name, recording in zip(("one.wav", "two.wav"), heard, strict=True):
        write_wav(name, recording.samples(), one.sample_rate)


asyncio.run(play(*sys.argv[1:]))
