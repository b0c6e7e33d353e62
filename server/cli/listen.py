"""`nafir listen`: the package for clients does it, as any client would."""

import math
from pathlib import Path
from typing import Annotated

import typer

from server.core.command_line import writable_file
from server.core.errors import NafirError


def listen(
    url: Annotated[str, typer.Argument(help="The server's address.")] = "ws://127.0.0.1:8000",
    scene: Annotated[str, typer.Option(help="Id of a scene that it serves.")] = "apartment",
    clip: Annotated[str, typer.Option(help="Name of a clip that it has.")] = "woman-reading",
    seconds: Annotated[float | None, typer.Option(min=0.1, help="How long. [default: until Ctrl+C]")] = None,
    walk_s: Annotated[float, typer.Option(min=0.1, help="How long the walk takes, one way.")] = 12.0,
    stay: Annotated[bool, typer.Option("--stay", help="Stay where visitors of the scene begin.")] = False,
    level: Annotated[str, typer.Option(help="Quality level of the scene, or auto.")] = "auto",
    sample_rate: Annotated[int | None, typer.Option(help="In Hz. [default: the scene's]")] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="WAV file to write, and beside it the path as it was heard, as a CSV file.",
            callback=writable_file,
        ),
    ] = None,
    silent: Annotated[bool, typer.Option("--silent", help="Only write the file, without a sound card.")] = False,
    device: Annotated[str, typer.Option(help="Sound card: a name or number of sounddevice's.")] = "",
) -> None:
    """Play or record a walk through a scene of a running server, with a meter in the terminal.

    A server that asks for a key gets that of the environment, NAFIR_API_KEY.
    """
    try:
        from nafir_client.errors import NafirClientError
        from nafir_client.listening import Listening
        from nafir_client.listening import listen as hear
    except ImportError as exc:
        problem = "nafir listen needs the package nafir-client: pip install 'client_examples/python[listen]'"
        raise NafirError(problem) from exc
    wish = Listening(
        url,
        scene=scene,
        clip=clip,
        seconds=math.inf if seconds is None else seconds,
        walk_s=walk_s,
        stays=stay,
        level=level,
        sample_rate=sample_rate,
        output=output,
        is_silent=silent,
        device=device,
    )
    try:
        hear(wish, typer.echo)
    except (NafirClientError, ValueError, OSError) as exc:
        raise NafirError(str(exc)) from exc
