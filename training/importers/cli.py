"""`nafir-train import`: measured or simulated responses of others, in the layouts they are published in.

What reads them is imported where it is used: every command of `nafir-train` loads this module.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer
from rich.console import Console
from rich.progress import track

from server.core.command_line import StrictTyper
from server.core.files import require_writable_folder
from training.importers.receivers import Receivers
from training.options import Json

if TYPE_CHECKING:
    from training.responses import Measurement

importing = StrictTyper(
    no_args_is_help=True, help="Import responses in the layout of SoundSpaces, MeshRIR, RAF or SOFA."
)

_T = TypeVar("_T")

Source = Annotated[Path, typer.Argument(help="Folder to read.")]
Output = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")]
HeldOut = Annotated[
    float, typer.Option("--held-out", min=0.0, max=0.9, help="Share of pairs that training never sees.")
]
Seed = Annotated[int, typer.Option(min=0, help="Chooses the pairs held out.")]
Latency = Annotated[int, typer.Option(help="Delay of the equipment to take off, samples at the source's rate.")]
Rate = Annotated[int | None, typer.Option("--sample-rate", min=1, help="Resample to this; otherwise the rate is kept.")]
Duration = Annotated[
    float | None, typer.Option("--duration-s", min=0.001, help="Longest response; all of it otherwise.")
]


@dataclass(frozen=True)
class _Options:
    """Those of every layout."""

    held_out: float
    seed: int
    latency_samples: int
    sample_rate: int | None
    duration_s: float | None
    as_json: bool


@importing.command("soundspaces")
def import_soundspaces(
    source: Source,
    output: Output,
    points: Annotated[Path | None, typer.Option(help="points.txt, where it is not beside the azimuths.")] = None,
    held_out: HeldOut = 0.1,
    seed: Seed = 0,
    latency_samples: Latency = 0,
    sample_rate: Rate = None,
    duration_s: Duration = None,
    as_json: Json = False,
) -> None:
    """A scene of SoundSpaces 1.0: points.txt and <azimuth>/<receiver>_<source>.wav, binaural."""
    from training.importers.soundspaces import read

    options = _Options(held_out, seed, latency_samples, sample_rate, duration_s, as_json)
    _import("soundspaces", source, output, options, partial(read, points=points))


@importing.command("meshrir")
def import_meshrir(
    source: Source,
    output: Output,
    source_rate: Annotated[int, typer.Option(min=1, help="Rate of the arrays, which do not tell it.")] = 48_000,
    held_out: HeldOut = 0.1,
    seed: Seed = 0,
    latency_samples: Latency = 0,
    sample_rate: Rate = None,
    duration_s: Duration = None,
    as_json: Json = False,
) -> None:
    """A room of MeshRIR: pos_mic.npy, pos_src.npy and ir_<microphone>.npy, one channel."""
    from training.importers.meshrir import read

    options = _Options(held_out, seed, latency_samples, sample_rate, duration_s, as_json)
    _import("meshrir", source, output, options, partial(read, source_rate=source_rate))


@importing.command("raf")
def import_raf(
    source: Source,
    output: Output,
    held_out: HeldOut = 0.1,
    seed: Seed = 0,
    latency_samples: Latency = 0,
    sample_rate: Rate = None,
    duration_s: Duration = None,
    as_json: Json = False,
) -> None:
    """A room of Real Acoustic Fields: rir.wav, rx_pos.txt and tx_pos.txt in numbered folders, one channel."""
    from training.importers.raf import read

    options = _Options(held_out, seed, latency_samples, sample_rate, duration_s, as_json)
    _import("raf", source, output, options, read)


@importing.command("sofa")
def import_sofa(
    source: Annotated[Path, typer.Argument(help="SOFA file to read.")],
    output: Output,
    receivers: Annotated[Receivers | None, typer.Option(help="What receivers are, if the convention errs.")] = None,
    held_out: HeldOut = 0.1,
    seed: Seed = 0,
    latency_samples: Latency = 0,
    sample_rate: Rate = None,
    duration_s: Duration = None,
    as_json: Json = False,
) -> None:
    """A SOFA file of a room: SingleRoomSRIR, SingleRoomMIMOSRIR, MultiSpeakerBRIR, or binaural SimpleFreeFieldHRIR."""
    from training.importers.sofa import read

    options = _Options(held_out, seed, latency_samples, sample_rate, duration_s, as_json)
    _import("sofa", source, output, options, partial(read, receivers=receivers))


def _import(
    layout: str,
    source: Path,
    output: Path,
    options: _Options,
    read: Callable[..., Iterator[tuple[str, "Measurement"]]],
) -> None:
    from training.importers.conditioning import Conditioning, SourceError, conditioned
    from training.importers.report import ImportReport
    from training.responses import ImportedDataset

    if not source.exists():
        raise SourceError(source, "source", "no such file or folder")
    require_writable_folder(output, "--output")
    console = Console(stderr=True)

    def tracked(items: Sequence[_T]) -> Iterable[_T]:
        return track(items, f"importing {layout}", console=console)

    report = ImportReport()
    conditioning = Conditioning(options.latency_samples, options.sample_rate, options.duration_s)
    measurements = conditioned(read(source, report, track=tracked), conditioning, report)
    dataset = ImportedDataset.write(
        output,
        measurements,
        report,
        layout=layout,
        source=str(source),
        held_out_share=options.held_out,
        seed=options.seed,
    )
    pairs, of_pairs = len(set(dataset.pair)), len(set(dataset.pair[dataset.held_out]))
    if options.as_json:
        told = {
            "folder": str(output),
            "layout": layout,
            "responses": len(dataset.yaw),
            "pairs": pairs,
            "held_out_pairs": of_pairs,
            "sample_rate": dataset.sample_rate,
            "samples": dataset.samples,
            "channels": dataset.channels,
            "report": report.to_json(),
        }
        typer.echo(json.dumps(told, indent=2))
        return
    Console(width=None if console.is_terminal else 140).print(report.table())
    typer.echo(
        f"{output}: {pairs - of_pairs} pairs to train on and {of_pairs} held out, "
        f"{dataset.channels} channel{'s' if dataset.channels > 1 else ''} of {dataset.samples} samples "
        f"at {dataset.sample_rate} Hz"
    )
