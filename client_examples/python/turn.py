"""Turn the head without the server, and store what the ears hear.

    pip install './client_examples/python[record]'
    python turn.py --url ws://127.0.0.1:8000 --scene SCENE -o heard.wav

Opens an ambisonic stream, and plays a clip where the scene suggests. The listener stands still and looks around, once
in a circle. The server hears nothing of that: every block is turned here, by the orientation that the head has at that
moment, and decoded to two ears with the head's filters, which the server gives over HTTP.

The scene has to know from where sound arrives. Those that do have `directional_levels` in GET /v1/scenes.
"""

import argparse
import asyncio
import math
from pathlib import Path

import numpy as np

import nafir_client
from nafir_client.ambisonics import Ears
from nafir_client.recording import Recording, write_wav


def orientation_at(time_s: float, duration_s: float, start_yaw: float) -> tuple[float, float, float, float]:
    """A head that turns once to the left, counter-clockwise, while it nods by ten degrees."""
    yaw, pitch = start_yaw + 2 * math.pi * time_s / duration_s, math.radians(10) * math.sin(2 * math.pi * time_s / 2)
    about_z, about_y = (math.sin(yaw / 2), math.cos(yaw / 2)), (-math.sin(pitch / 2), math.cos(pitch / 2))
    # The product of both quaternions: first the pitch, then the yaw.
    return (
        -about_z[0] * about_y[0],
        about_z[1] * about_y[0],
        about_z[0] * about_y[1],
        about_z[1] * about_y[1],
    )


async def listen(arguments: argparse.Namespace) -> None:
    options = {"scene": arguments.scene, "output": "ambisonics", "order": arguments.order, "reconnect": None}
    async with nafir_client.connect(arguments.url, **options) as stream:
        rate, head = stream.sample_rate, {"order": arguments.order, "sample_rate": stream.sample_rate}
        filters = await asyncio.to_thread(nafir_client.Client(arguments.url).head_filters, arguments.head, **head)
        clip = await stream.add_emitter(clip=arguments.clip)
        recording = Recording(clip.start_clock)
        async for block in stream:
            recording.add(block)
            if recording.frames >= arguments.seconds * rate:
                break
    received, ears, heard = recording.samples(), Ears(filters), []
    for end in range(stream.block_size, len(received) + 1, stream.block_size):
        orientation = orientation_at(end / rate, arguments.seconds, stream.scene.listener.yaw)
        heard.append(ears.process(received[end - stream.block_size : end], orientation))
    write_wav(arguments.output, np.concatenate(heard), rate)
    print(f"{arguments.output}: {len(received) / rate:.2f} s through the head {arguments.head}")
    if arguments.received:
        write_wav(arguments.received, received, rate)
        print(f"{arguments.received}: ambisonics of order {arguments.order}, in the axes of the scene")


def main() -> None:
    parser = argparse.ArgumentParser(description="Turn the head without the server, and store what the ears hear.")
    parser.add_argument("--url", default="ws://127.0.0.1:8000")
    parser.add_argument("--scene", default="open-field", help="one that knows directions")
    parser.add_argument("--clip", default="woman-reading", help="one of GET /v1/clips")
    parser.add_argument("--head", default="kemar", help="one of GET /v1/hrtfs")
    parser.add_argument("--order", type=int, default=1, choices=(1, 2, 3), help="of the ambisonics")
    parser.add_argument("--seconds", type=float, default=8.0, help="how long the turn takes")
    parser.add_argument("-o", "--output", type=Path, default=Path("heard.wav"))
    parser.add_argument("--received", type=Path, help="file for the ambisonics as they arrived (AmbiX)")
    arguments = parser.parse_args()
    try:
        asyncio.run(listen(arguments))
    except nafir_client.NafirClientError as exc:
        raise SystemExit(str(exc)) from exc


if __name__ == "__main__":
    main()
