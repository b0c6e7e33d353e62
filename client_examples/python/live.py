"""Send live sound to a scene, and store the sound that comes back.

    pip install './client_examples/python[clips]'
    python live.py --input voice.wav --url ws://127.0.0.1:8000 -o wet.wav

Adds a live emitter where the scene suggests, and sends it a recording, as a microphone would (claps, if there is no
recording). The sound that comes back is the recording as heard from the scene's starting place.
"""

import argparse
import asyncio
from pathlib import Path

import nafir_client
from nafir_client.clips import claps, load_clip
from nafir_client.recording import Recording, level_sentence, write_wav


async def perform(arguments: argparse.Namespace) -> None:
    messages: dict[str, nafir_client.Message] = {}

    def note(message: nafir_client.Message) -> None:
        messages[message["type"]] = message
        if message["type"] == "level_changed":
            print(level_sentence(message, stream.sample_rate))

    wishes = {"level": arguments.level, "effects": dict(arguments.effect)}
    stream = nafir_client.connect(arguments.url, scene=arguments.scene, reconnect=None, on_message=note, **wishes)
    async with stream:
        print(f"level {stream.level}")
        rate = stream.sample_rate
        dry = load_clip(arguments.input, rate) if arguments.input else claps(rate)
        microphone = await stream.add_emitter(id="microphone", ahead_blocks=arguments.ahead)
        sending = asyncio.create_task(microphone.write(dry))
        recording = Recording(microphone.start_clock)
        # Until the end of the recording has been played and has decayed.
        length = len(dry) + arguments.ahead * stream.block_size + stream.welcome.ir_samples + rate // 2
        async for block in stream:
            recording.add(block)
            if recording.frames >= length:
                break
        await sending
    write_wav(arguments.output, recording.samples(length), rate)
    print(f"{arguments.output}: {length / rate:.2f} s, {len(dry) / rate:.2f} s of them sent")
    for live in messages.get("status", {}).get("live", []):
        # The end of the recording is one more.
        print(f"{max(0, live['underruns'] - 1)} underruns, {live['samples_dropped']} samples dropped")


def effect(text: str) -> tuple[str, bool]:
    name, _, state = text.partition("=")
    if state not in ("on", "off"):
        raise argparse.ArgumentTypeError(f"{text!r} is neither NAME=on nor NAME=off")
    return name, state == "on"


def main() -> None:
    parser = argparse.ArgumentParser(description="Send live sound to a scene, and store the sound that comes back.")
    parser.add_argument("--url", default="ws://127.0.0.1:8000")
    parser.add_argument("--scene", default="apartment")
    parser.add_argument("--level", default="auto", help="a quality level of GET /v1/scenes/SCENE/frontier")
    effects = "an effect to have or to leave out, whatever the server's plan says; repeatable"
    parser.add_argument("--effect", type=effect, action="append", default=[], metavar="NAME=on|off", help=effects)
    parser.add_argument("--input", type=Path, help="audio file to send (default: claps)")
    ahead = "blocks sent ahead: more for a worse network, fewer to hear them sooner"
    parser.add_argument("--ahead", type=int, default=4, help=ahead)
    parser.add_argument("-o", "--output", type=Path, default=Path("wet.wav"))
    arguments = parser.parse_args()
    try:
        asyncio.run(perform(arguments))
    except nafir_client.NafirClientError as exc:
        raise SystemExit(str(exc)) from exc


if __name__ == "__main__":
    main()
