"""Walk through a scene and store the sound.

    pip install './client_examples/python[record]'
    python walk.py --url ws://127.0.0.1:8000 -o heard.wav

Plays a clip where the scene suggests, and walks from the scene's starting place through its openings towards the clip
while looking around. It writes two files: the sound as it arrived, and the path as it was heard. For each pose, the
path has the sample from which on the direct sound was heard from it, the sample for the reverberation, which follows
later and skips poses, and the quality level. `nafir render` makes the same sound from that path, to the sample, unless
the server was under load. The walk says so then.
"""

import asyncio
from argparse import Namespace
from pathlib import Path

import nafir_client
from nafir_client.command_line import add_clip, add_level, program, run
from nafir_client.recording import PathAsHeard, level_sentence, record, render_command, write_wav
from nafir_client.walk import Walk

EVERYTHING = dict.fromkeys(nafir_client.EFFECTS, True)
"""Effects, so that an offline render has the same samples; a game leaves them to the server's plan."""


async def listen(wish: Namespace) -> None:
    def note(message: nafir_client.Message) -> None:
        path.note_message(message)
        if message["type"] == "level_changed":
            print(level_sentence(message, stream.sample_rate))

    path, options = PathAsHeard(), {"scene": wish.scene, "level": wish.level, "effects": EVERYTHING}
    async with nafir_client.connect(wish.url, reconnect=None, on_message=note, **options) as stream:
        print(f"level {stream.level}")
        walk = Walk.through(stream.scene, wish.seconds)
        await walk.go(stream, path)  # before the clip is added, so that it begins with this pose and not the scene's
        clip = await stream.add_emitter(clip=wish.clip)
        walking = asyncio.create_task(walk.stroll(stream, path))
        frames = clip.start_clock + round(wish.seconds * stream.sample_rate)
        recording = await record(stream, frames, note_block=path.note_block)
        walking.cancel()

    csv, duration_s = wish.path or wish.output.with_name("path.csv"), recording.frames / stream.sample_rate
    rows = path.write(csv, clip.start_clock, stream.welcome.level)
    write_wav(wish.output, recording.samples(), stream.sample_rate)
    print(f"{wish.output}: {duration_s:.2f} s; {csv}: {rows} poses", *stream.statistics.sentences(), sep="\n")
    print(f"Render it again:\n  {render_command(stream.scene, wish.clip, csv, duration_s)}")
    if path.was_under_load:
        print("The server was under load and used parts of responses again: the samples will differ.")


parser = program("Walk through a scene and store the sound.", output="heard.wav")
add_clip(parser, seconds=12.0)
add_level(parser)
parser.add_argument("--path", type=Path, help="CSV of the path as heard (default: path.csv beside the output)")

if __name__ == "__main__":
    run(listen, parser)
