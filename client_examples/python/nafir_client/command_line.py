"""The command `nafir-client`, and what programs like it share."""

import argparse
import asyncio
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path

from nafir_client.errors import NafirClientError
from nafir_client.listening import Listening, listen


def program(about: str, *, output: str, scene: str = Listening.scene) -> argparse.ArgumentParser:
    """A parser for a program that listens to a scene and writes a file: with the server, the scene and the output."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--url", default="ws://127.0.0.1:8000", help="the server's; default: %(default)s")
    parser.add_argument("--scene", default=scene, help="one of GET /v1/scenes; default: %(default)s")
    parser.add_argument("-o", "--output", type=Path, default=Path(output), help="WAV file; default: %(default)s")
    return parser


def add_clip(parser: argparse.ArgumentParser, *, seconds: float) -> None:
    """Options for what plays, and for how long."""
    parser.add_argument("--clip", default=Listening.clip, help="one of GET /v1/clips; default: %(default)s")
    parser.add_argument("--seconds", type=float, default=seconds, help="how long it takes; default: %(default)g")


def add_level(parser: argparse.ArgumentParser) -> None:
    """An option for the quality level."""
    about = "a quality level of GET /v1/scenes/SCENE/frontier; default: %(default)s"
    parser.add_argument("--level", default=Listening.level, help=about)


def effect(text: str) -> tuple[str, bool]:
    """An effect and whether it is wanted, as the type of an option `NAME=on|off`."""
    name, _, state = text.partition("=")
    if state not in ("on", "off"):
        raise argparse.ArgumentTypeError(f"{text!r} is neither NAME=on nor NAME=off")
    return name, state == "on"


def run(body: Callable[[argparse.Namespace], Coroutine[object, object, None]], parser: argparse.ArgumentParser) -> None:
    """Run a program with the options of its command line. A NafirClientError ends the process with its line and exit
    code 1."""
    try:
        asyncio.run(body(parser.parse_args()))
    except NafirClientError as exc:
        raise SystemExit(str(exc)) from exc


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the console script. Errors end the process with one line and exit code 2."""
    parser = argparse.ArgumentParser(prog="nafir-client", description="Streams of a Nafir server.")
    commands = parser.add_subparsers(dest="command", required=True)
    about = "play or record a walk through a scene, with a meter in the terminal"
    command = commands.add_parser("listen", help=about, description=f"{about[0].upper()}{about[1:]}.")
    command.add_argument("url", help="the server's, such as ws://127.0.0.1:8000")
    command.add_argument("--scene", default=Listening.scene, help="default: %(default)s")
    command.add_argument("--clip", default=Listening.clip, help="one of GET /v1/clips; default: %(default)s")
    command.add_argument("--seconds", type=float, default=Listening.seconds, help="how long; default: until Ctrl+C")
    command.add_argument("--walk-s", type=float, default=Listening.walk_s, help="how long the walk takes one way")
    command.add_argument("--stay", dest="stays", action="store_true", help="stay where the scene's visitors begin")
    command.add_argument("--level", default=Listening.level, help="a quality level of the scene; default: auto")
    command.add_argument("--sample-rate", type=int, help="in Hz; default: the scene's")
    command.add_argument("-o", "--output", type=Path, help="WAV file to write, beside it the path as a CSV file")
    command.add_argument("--silent", dest="is_silent", action="store_true", help="write only, without a sound card")
    command.add_argument("--device", default="", help="sound card: a name or number of sounddevice's")
    wish = {name: value for name, value in vars(parser.parse_args(arguments)).items() if name != "command"}
    try:
        listen(Listening(**wish), print)
    except (NafirClientError, ValueError, OSError) as exc:
        print(f"error: {exc}", file=sys.stderr)
        sys.exit(2)
