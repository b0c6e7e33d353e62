"""The command `nafir-client`."""

import argparse
import sys
from pathlib import Path

from nafir_client.errors import NafirClientError
from nafir_client.listening import Listening, listen


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
