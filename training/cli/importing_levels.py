"""`nafir-train import-level` imports a level of a game and reports on its mesh; `nafir-train bundle-level` makes a
scene bundle of it."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from server.core.command_line import writable_folder
from server.core.files import require_matplotlib
from server.scene.limits import HIGHEST_RATE_HZ, LOWEST_RATE_HZ
from training.cli.options import Json, Seed
from training.data.levels.import_options import MERGE_WITHIN_M, PROBES, RAYS, SAMPLE_RATE_HZ, Handedness, Units, Up
from training.data.limits import FEWEST_PROBES, FEWEST_RAYS, MOST_PROBES, MOST_RAYS

if TYPE_CHECKING:
    from training.data.levels.level_import import Choices

MOST_MERGED_M = 0.1

LevelPath = Annotated[Path, typer.Argument(help="Level to read: .glb, .gltf or .obj.")]
UnitsOption = Annotated[
    Units | None, typer.Option("--units", help="Unit of coordinates; OBJ does not say it, glTF has metres.")
]
UpOption = Annotated[Up | None, typer.Option("--up", help="Axis that points up; OBJ does not say it, in glTF it is y.")]
HandednessOption = Annotated[Handedness | None, typer.Option("--handedness", help="Of the axes; right if not given.")]
SceneName = Annotated[
    str | None, typer.Option("--scene", help="Which scene, by name or number, where a file has several.")
]
MaterialsFile = Annotated[
    Path | None, typer.Option("--materials", help="TOML file that says what the level's materials are.")
]
DefaultMaterial = Annotated[
    str | None, typer.Option("--default-material", help="Row of the table for materials that are in neither.")
]
OpenSky = Annotated[bool, typer.Option("--open", help="The level has open sky: sound may leave it.")]
MergeWithin = Annotated[
    float,
    typer.Option(
        "--merge-within-m",
        min=0.0,
        max=MOST_MERGED_M,
        help="Merge flat triangles; no surface moves farther. 0 merges none.",
    ),
]
SampleRate = Annotated[
    int,
    typer.Option(
        "--sample-rate",
        min=LOWEST_RATE_HZ,
        max=HIGHEST_RATE_HZ,
        help="Of simulated responses, in Hz. They hold sound up to half of it.",
    ),
]
Rays = Annotated[
    int,
    typer.Option("--rays", min=FEWEST_RAYS, max=MOST_RAYS, help="Of each emitter in the simulation."),
]

ProbeCount = Annotated[
    int,
    typer.Option("--probes", min=FEWEST_PROBES, max=MOST_PROBES, help="About how many places to simulate."),
]


def import_level(
    level: LevelPath,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.", callback=writable_folder)],
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
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Read a level (glTF or OBJ), examine and mend its mesh, and write scene.toml, geometry.npz and a report."""
    require_matplotlib("import-level")
    from training.data.levels.level_import import Choices

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
    write_scene(level, choices, output, as_json=as_json)


def write_scene(level: Path, choices: "Choices", output: Path, *, as_json: bool = False) -> None:
    """Imports a level and prints its report. Raises LevelError for one that is refused, whose report is written."""
    from training.data.levels.level_import import PICTURE_FILE, write_level
    from training.data.levels.level_import import import_level as read_level
    from training.data.levels.level_source import LevelError

    with Console(stderr=True).status(f"examining {level.name}"):
        imported = read_level(level, choices)
        write_level(imported, output)
    report = imported.report
    if as_json:
        typer.echo(json.dumps(report.to_json(), indent=2))
    else:
        console = Console()
        Console(width=None if console.is_terminal else 150).print(report.tables())
    if imported.scene is None:
        raise LevelError(level, "refused", f"{'; '.join(report.problems)} (drawn in {output / PICTURE_FILE})")
    if not as_json:
        doors, named = len(imported.scene.doors), len(imported.scene.file.geometry.materials)
        typer.echo(
            f"{output}: {len(imported.scene.mesh.triangles):,} triangles, {named} materials, {doors} "
            f"door{'' if doors == 1 else 's'}; drawn in {output / PICTURE_FILE}"
        )


def bundle_level(
    scene: Annotated[Path, typer.Argument(help="Folder of an imported level, or a scene file in it.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.", callback=writable_folder)],
    as_json: Json = False,
) -> None:
    """Write an imported level as a scene bundle without a field: a server renders its direct sound, what comes round
    edges and through walls, and first reflections."""
    from training.bundling.level_bundle import bundle_of_level
    from training.data.levels.level_scene import LevelScene

    bundle = bundle_of_level(LevelScene.read(scene), output)
    assert bundle.mesh is not None
    count = len(bundle.mesh.triangles)
    if as_json:
        typer.echo(json.dumps({"scene": bundle.id, "digest": bundle.digest, "triangles": count}))
    else:
        typer.echo(f"{output}: scene {bundle.id}, {count:,} triangles, digest {bundle.digest[:12]}")
