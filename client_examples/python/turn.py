"""Turn the head without the server, and store what the ears hear.

    pip install './client_examples/python[record]'
    python turn.py --url ws://127.0.0.1:8000 --scene SCENE -o heard.wav

Opens an ambisonic stream, and plays a clip where the scene suggests. The listener stands still and looks around, once
in a circle. The server hears nothing of that: every block is turned here, by the orientation that the head has at that
moment, and decoded to two ears with the head's filters, which the server gives over HTTP.

The scene has to know from where sound arrives. Those that do have `directional_levels` in GET /v1/scenes.
"""

import asyncio
import math
from argparse import Namespace
from pathlib import Path

import numpy as np

import nafir_client
from nafir_client.ambisonics import Ears
from nafir_client.command_line import add_clip, program, run
from nafir_client.pose import Orientation, turned
from nafir_client.recording import record, write_wav


def orientation_at(time_s: float, duration_s: float, start_yaw: float) -> Orientation:
    """A head that turns once to the left, counter-clockwise, while it nods by ten degrees."""
    nod = math.radians(10) * math.sin(2 * math.pi * time_s / 2)
    return turned(start_yaw + 2 * math.pi * time_s / duration_s, nod)


async def listen(wish: Namespace) -> None:
    options = {"scene": wish.scene, "output": "ambisonics", "order": wish.order, "reconnect": None}
    async with nafir_client.connect(wish.url, **options) as stream:
        rate, size, start_yaw = stream.sample_rate, stream.block_size, stream.scene.listener.yaw
        head = {"order": wish.order, "sample_rate": rate}
        ears = Ears(await asyncio.to_thread(nafir_client.Client(wish.url).head_filters, wish.head, **head))
        clip = await stream.add_emitter(clip=wish.clip)
        recording = await record(stream, round(wish.seconds * rate), start_clock=clip.start_clock)
    received = recording.samples()
    heard = [
        ears.process(received[end - size : end], orientation_at(end / rate, wish.seconds, start_yaw))
        for end in range(size, len(received) + 1, size)
    ]
    write_wav(wish.output, np.concatenate(heard), rate)
    print(f"{wish.output}: {len(received) / rate:.2f} s through the head {wish.head}")
    if wish.received:
        write_wav(wish.received, received, rate)
        print(f"{wish.received}: ambisonics of order {wish.order}, in the axes of the scene")


parser = program("Turn the head without the server, and store what it hears.", output="heard.wav", scene="open-field")
add_clip(parser, seconds=8.0)
parser.add_argument("--head", default="kemar", help="one of GET /v1/hrtfs")
parser.add_argument("--order", type=int, default=1, choices=(1, 2, 3), help="of the ambisonics")
parser.add_argument("--received", type=Path, help="file for the ambisonics as they arrived (AmbiX)")

if __name__ == "__main__":
    run(listen, parser)
