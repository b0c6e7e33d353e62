"""`nafir-train bake`: from a level to a bundle in one command."""

import os
import shlex
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import typer

from server.core.command_line import require_at_most_one
from server.core.files import require_matplotlib
from training.cli.exporting import export
from training.cli.importing_levels import (
    DefaultMaterial,
    HandednessOption,
    LevelPath,
    MaterialsFile,
    MergeWithin,
    OpenSky,
    ProbeCount,
    Rays,
    SampleRate,
    SceneName,
    UnitsOption,
    UpOption,
    write_scene,
)
from training.cli.learning import Minutes, train_into
from training.cli.options import Folder, Seed
from training.cli.simulating import Workers, simulate_into
from training.data.levels.import_options import MERGE_WITHIN_M, PROBES, RAYS, SAMPLE_RATE_HZ

EPOCHS = 40
"""Of training. Levels have ten times as many pairs as a room of a hundred epochs."""


def bake(
    level: LevelPath,
    output: Folder,
    units: UnitsOption = None,
    up: UpOption = None,
    handedness: HandednessOption = None,
    scene: SceneName = None,
    materials: MaterialsFile = None,
    default_material: DefaultMaterial = None,
    is_open: OpenSky = False,
    merge_within_m: MergeWithin = MERGE_WITHIN_M,
    sample_rate: SampleRate = SAMPLE_RATE_HZ,
    rays: Rays = RAYS,
    probes: ProbeCount = PROBES,
    epochs: Annotated[
        int | None, typer.Option(min=1, help=f"Passes over the training set; {EPOCHS} if not given.")
    ] = None,
    minutes: Minutes = None,
    seed: Seed = 0,
    workers: Workers = 0,
    anew: Annotated[
        bool, typer.Option("--anew", help="Where something has changed, make anew what follows from it.")
    ] = False,
) -> None:
    """Make a level a bundle to serve: import it, simulate it, train a directional field on it, and export that. Run
    again after an interruption to go on."""
    # The simulation and the targets have threads of their own, of which each multiplies alone; so has torch.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    require_matplotlib("bake")
    require_at_most_one({"--epochs": epochs is not None, "--minutes": minutes is not None})
    from training.bundling.bake import Bake, BakeError, Stage
    from training.bundling.level_bundle import require_bundled
    from training.data.levels.level_import import Choices
    from training.data.levels.level_scene import LevelScene
    from training.learning.runs import configure

    choices = Choices(
        units,
        up,
        handedness,
        scene,
        materials,
        default_material,
        is_open,
        merge_within_m,
        sample_rate,
        rays,
        probes,
        seed,
    )
    length: dict[str, Any] = {"epochs": epochs or EPOCHS} if minutes is None else {"minutes": minutes}
    configuration = configure("directional", seed=seed, **length)
    baked = Bake(output, level, choices, configuration)
    imported, data, run, bundle = map(baked.path, Stage)

    def import_it() -> None:
        write_scene(level, choices, imported)
        baked.note_import()

    def simulate_it() -> None:
        require_bundled(LevelScene.read(imported))  # before hours of work for it
        simulate_into(data, imported, effects="plan", seed=seed, workers=workers)

    def export_it() -> None:
        export([run], bundle, data=data)
        baked.note_export()

    make: Mapping[Stage, Callable[[], None]] = {
        Stage.IMPORT: import_it,
        Stage.SIMULATE: simulate_it,
        Stage.TRAIN: lambda: train_into(run, data, configuration),
        Stage.EXPORT: export_it,
    }
    baked.claim()
    for number, stage in enumerate(Stage, start=1):
        changed = ", ".join(baked.changes(stage))
        if changed and not anew:
            raise BakeError(
                f"{baked.path(stage)}: since it was begun, this has changed: {changed}. Add --anew to make anew what "
                "follows from that, or bake into an empty folder"
            )
        if changed:
            typer.echo(f"{baked.path(stage)}: is made anew, because this has changed: {changed}")
            baked.drop(stage)
        if baked.is_finished(stage):
            typer.echo(f"{baked.path(stage)}: is finished already")
        else:
            typer.echo(f"step {number} of {len(Stage)}: {stage.name.lower()}", err=True)
            make[stage]()
    typer.echo(f"serve it: nafir serve --bundle {shlex.quote(str(bundle))}")
