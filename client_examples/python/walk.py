"""Walk through a scene and store the sound.

    pip install './client_examples/python[record]'
    python walk.py --url ws://127.0.0.1:8000 -o heard.wav

Plays a clip where the scene suggests, and walks from the scene's starting place through its openings towards the clip
while looking around. It writes two files: the sound as it arrived, and the path as it was heard. For each pose, the
path has the sample from which on the direct sound was heard from it, the sample for the reverberation, which follows
later and skips poses, and the quality level. `nafir render` makes the same sound from that path, to the sample.
"""

import argparse
import asyncio
from pathlib import Path

import nafir_client
from nafir_client.recording import PathAsHeard, Recording, level_sentence, write_wav
from nafir_client.walk import Walk

POSES_PER_SECOND = 30


async def listen(arguments: argparse.Namespace) -> None:
    path, recording = PathAsHeard(), Recording()

    def note(message: nafir_client.Message) -> None:
        path.note_message(message)
        if message["type"] == "level_changed":
            print(level_sentence(message, stream.sample_rate))

    async def go(step: int) -> None:
        pose = walk.pose_at(step / POSES_PER_SECOND)
        path.note_pose(await stream.move_listener(pose.position, orientation=pose.orientation), pose)

    async def stroll() -> None:
        started_s = (loop := asyncio.get_running_loop()).time()
        for step in range(1, round(arguments.seconds * POSES_PER_SECOND) + 1):
            await asyncio.sleep(started_s + step / POSES_PER_SECOND - loop.time())
            await go(step)

    # All effects are on, so that an offline render has the same samples; a game leaves them to the server's plan.
    wishes = {"scene": arguments.scene, "level": arguments.level, "effects": dict.fromkeys(nafir_client.EFFECTS, True)}
    stream = nafir_client.connect(arguments.url, reconnect=None, on_message=note, **wishes)
    async with stream:
        print(f"level {stream.level}")
        walk = Walk.through(stream.scene, arguments.seconds)
        await go(0)  # before the clip is added, so that it begins with this pose and not with the scene's
        clip = await stream.add_emitter(clip=arguments.clip)
        walking = asyncio.create_task(stroll())
        async for block in stream:
            recording.add(block)
            path.note_block(block)
            if recording.frames - clip.start_clock >= arguments.seconds * stream.sample_rate:
                break
        walking.cancel()

    rate, rows = stream.sample_rate, path.write(arguments.path, clip.start_clock, stream.welcome.level)
    write_wav(arguments.output, recording.samples(), rate)
    print(f"{arguments.output}: {recording.frames / rate:.2f} s; {arguments.path}: {rows} poses")
    waits = stream.statistics
    for part, poses in (("direct sound", waits.pose_to_sound), ("reverberation", waits.pose_to_reverberation)):
        print(f"{part}: {len(poses.durations)} poses, received {poses.durations.median_ms:.0f} ms after they were sent")
    print(f"{waits.blocks_late} blocks late")
    x, y, z = stream.scene.emitter.position
    print(
        f"Render it again:\n  nafir render {arguments.scene} --effects all "
        f"--emitter {arguments.clip}@{x:g},{y:g},{z:g} --loop "
        f"--path {arguments.path} --duration-s {recording.frames / rate:.6f} -o again.wav"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Walk through a scene and store the sound.")
    parser.add_argument("--url", default="ws://127.0.0.1:8000")
    parser.add_argument("--scene", default="apartment")
    parser.add_argument("--clip", default="woman-reading", help="one of GET /v1/clips")
    parser.add_argument("--level", default="auto", help="a quality level of GET /v1/scenes/SCENE/frontier")
    parser.add_argument("--seconds", type=float, default=12.0, help="how long the walk takes")
    parser.add_argument("-o", "--output", type=Path, default=Path("heard.wav"))
    parser.add_argument("--path", type=Path, help="CSV of the path as heard (default: path.csv beside the output)")
    arguments = parser.parse_args()
    arguments.path = arguments.path or arguments.output.with_name("path.csv")
    try:
        asyncio.run(listen(arguments))
    except nafir_client.NafirClientError as exc:
        raise SystemExit(str(exc)) from exc


if __name__ == "__main__":
    main()
