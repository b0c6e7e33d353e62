"""Send live sound to a scene, and store the sound that comes back.

    pip install './client_examples/python[clips]'
    python live.py --input voice.wav --url ws://127.0.0.1:8000 -o wet.wav

Adds a live emitter where the scene suggests, and sends it a recording, as a microphone would (claps, if there is no
recording). The sound that comes back is the recording as heard from the scene's starting place.
"""

import asyncio
from argparse import Namespace
from pathlib import Path

import nafir_client
from nafir_client.clips import claps, load_clip
from nafir_client.command_line import add_level, effect, program, run
from nafir_client.recording import level_sentence, record, write_wav


async def perform(wish: Namespace) -> None:
    def note(message: nafir_client.Message) -> None:
        messages[message["type"]] = message
        if message["type"] == "level_changed":
            print(level_sentence(message, stream.sample_rate))

    messages: dict[str, nafir_client.Message] = {}
    options = {"scene": wish.scene, "level": wish.level, "effects": dict(wish.effect)}
    async with nafir_client.connect(wish.url, reconnect=None, on_message=note, **options) as stream:
        print(f"level {stream.level}")
        rate = stream.sample_rate
        dry = load_clip(wish.input, rate) if wish.input else claps(rate)
        microphone = await stream.add_emitter(id="microphone", ahead_blocks=wish.ahead)
        sending = asyncio.create_task(microphone.write(dry))
        # Until the end of the recording has been played and has decayed.
        length = len(dry) + wish.ahead * stream.block_size + stream.welcome.ir_samples + rate // 2
        recording = await record(stream, length, start_clock=microphone.start_clock)
        await sending
    write_wav(wish.output, recording.samples(length), rate)
    print(f"{wish.output}: {length / rate:.2f} s, {len(dry) / rate:.2f} s of them sent")
    for live in messages.get("status", {}).get("live", []):
        # The end of the recording is one more.
        print(f"{max(0, live['underruns'] - 1)} underruns, {live['samples_dropped']} samples dropped")


parser = program("Send live sound to a scene, and store the sound that comes back.", output="wet.wav")
add_level(parser)
effects = "an effect to have or to leave out, whatever the server's plan says; repeatable"
parser.add_argument("--effect", type=effect, action="append", default=[], metavar="NAME=on|off", help=effects)
parser.add_argument("--input", type=Path, help="audio file to send (default: claps)")
ahead = "blocks sent ahead: more for a worse network, fewer to hear them sooner"
parser.add_argument("--ahead", type=int, default=4, help=ahead)

if __name__ == "__main__":
    run(perform, parser)
