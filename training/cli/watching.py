"""`nafir-train draw-views` and `cross-modal`: pictures of a scene, and networks that learn sight and sound together."""

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from server.core.command_line import writable_folder
from server.core.errors import NafirError
from server.core.numerals import parse_integer
from training.cli.options import FirstSeed, Json, Seed

Folder = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.", callback=writable_folder)]


def draw_views(
    scene: Annotated[Path, typer.Argument(help="Scene file (TOML).")],
    output: Folder,
    views: Annotated[int, typer.Option(min=1, max=10_000, help="Views to train on.")] = 150,
    test: Annotated[int, typer.Option(min=1, max=10_000, help="Views to test on, from other places.")] = 50,
    size: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT", help="Pixels of a picture.")] = "256x192",
    seed: Seed = 0,
) -> None:
    """Draw pictures of a scene, with furniture of our own: PNG files, and cameras.json with their cameras."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from training.data.scene_file import SceneFile
    from training.sight.views import draw_views as draw

    pixels = _size(size)
    draw(SceneFile.read(scene), output, views=views, test=test, size=pixels, seed=seed, track=_track())
    typer.echo(f"{output}: {views} views to train on and {test} to test on, {pixels[0]}x{pixels[1]} pixels")


def cross_modal(
    data: Annotated[Path, typer.Argument(help="Dataset folder from simulate.")],
    images: Annotated[Path, typer.Argument(help="Folder of pictures of the same scene, from draw-views.")],
    output: Folder,
    methods: Annotated[
        str, typer.Option(help="Any of nerf, nerf-naf, nerf-grid and nerf-grid-l2, separated by commas.")
    ] = "nerf,nerf-naf",
    views: Annotated[str, typer.Option(help="Numbers of views to train on, separated by commas.")] = "75,100,150",
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Trainings of each, a seed after the other.")] = 3,
    first_seed: FirstSeed = 0,
    small: Annotated[
        bool, typer.Option("--small", help="Start from sizes for two cores in place of the paper's.")
    ] = False,
    steps: Annotated[int | None, typer.Option(min=1, help="Training steps of each.")] = None,
    rays: Annotated[int | None, typer.Option(min=1, help="Rays of a step.")] = None,
    coarse: Annotated[int | None, typer.Option(min=2, help="Samples of a ray for the coarse network.")] = None,
    fine: Annotated[int | None, typer.Option(min=1, help="Further samples of a ray for the fine network.")] = None,
    width: Annotated[int | None, typer.Option(min=4, help="Width of both NeRF networks.")] = None,
    layers: Annotated[int | None, typer.Option(min=2, help="Layers of both NeRF networks.")] = None,
    learning_rate: Annotated[float | None, typer.Option(min=1e-7, help="Of all networks.")] = None,
    grid_spacing_m: Annotated[float | None, typer.Option(min=0.05, help="Between the cells of the grid.")] = None,
    grid_features: Annotated[int | None, typer.Option(min=1, help="Features of a cell.")] = None,
    naf_width: Annotated[int | None, typer.Option(min=4, help="Width of the acoustic field.")] = None,
    responses: Annotated[int | None, typer.Option(min=1, help="Responses of a step.")] = None,
    points: Annotated[int | None, typer.Option(min=1, help="Points of each response of a step.")] = None,
    share: Annotated[float | None, typer.Option(min=1e-4, max=1, help="Share of the pairs of DATA.")] = None,
    naf_weight: Annotated[float | None, typer.Option(min=0, help="Weight of the acoustic loss.")] = None,
    as_json: Json = False,
) -> None:
    """Train NeRFs alone and with the grid of an acoustic field, and compare new views. Run again to go on."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from dataclasses import replace

    from training.sight.comparison import compare, table
    from training.sight.joint import SMALL, Recipe

    given: dict[str, Any] = {
        "steps": steps,
        "rays": rays,
        "coarse": coarse,
        "fine": fine,
        "width": width,
        "layers": layers,
        "learning_rate": learning_rate,
        "grid_spacing_m": grid_spacing_m,
        "grid_features": grid_features,
        "naf_width": naf_width,
        "responses": responses,
        "points": points,
        "share": share,
        "naf_weight": naf_weight,
    }
    recipe = replace(SMALL if small else Recipe(), **{name: each for name, each in given.items() if each is not None})
    chosen = [name.strip() for name in methods.split(",") if name.strip()]
    result = compare(
        data, images, output, chosen, _numbers(views), range(first_seed, first_seed + seeds), recipe, _track()
    )
    if as_json:
        typer.echo(json.dumps(result, indent=2))
        return
    for line in table(result):
        typer.echo("".join(cell.ljust(18) for cell in line).rstrip())


def _track() -> Callable[[Iterable[Any], str], Iterable[Any]]:
    from rich.progress import track

    console = Console(stderr=True)
    return lambda steps, doing: track(steps, doing, console=console)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    try:
        size = parse_integer(width), parse_integer(height)
    except ValueError as exc:
        raise NafirError(f"--size: {text!r}: is not WIDTHxHEIGHT, 256x192 say") from exc
    if not 8 <= min(size) <= max(size) <= 4096:
        raise NafirError(f"--size: {text}: from 8 to 4096 pixels along each side")
    return size


def _numbers(text: str) -> list[int]:
    try:
        numbers = [parse_integer(part) for part in text.split(",")]
    except ValueError as exc:
        raise NafirError(f"--views: {text!r}: whole numbers, separated by commas: 75,100,150 say") from exc
    if min(numbers) < 1:
        raise NafirError(f"--views: {min(numbers)}: at least one view is needed to train on")
    return numbers
