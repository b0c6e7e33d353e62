"""`nafir-train import`: imports measured or simulated responses in published layouts.

Each command imports its reader when it runs, because every command of `nafir-train` loads this module.
"""

import json
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import typer
from rich.console import Console
from rich.progress import track

from server.core.command_line import StrictTyper, writable_folder
from server.scene.limits import HIGHEST_RATE_HZ, LOWEST_RATE_HZ, MOST_SAMPLES
from training.cli.options import Json
from training.data.importers.receivers import Receivers

if TYPE_CHECKING:
    from training.data.importers.conditioning import Conditioning
    from training.data.importers.report import ImportReport
    from training.data.responses import Measurement

importing = StrictTyper(no_args_is_help=True, help="Import responses; each command reads one published layout.")

_T = TypeVar("_T")
_MOST_LATENCY_SAMPLES = 1_000_000


class Axis(StrEnum):
    """A horizontal axis that can be mirrored. A vertical one would change nothing that ears could tell."""

    X = "x"
    Y = "y"


Source = Annotated[Path, typer.Argument(help="Folder to read.")]
Output = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.", callback=writable_folder)]
HeldOut = Annotated[
    float, typer.Option("--held-out", min=0.0, max=0.9, help="Share of pairs that training never sees.")
]
Seed = Annotated[int, typer.Option(min=0, help="Chooses the pairs held out.")]
Split = Annotated[
    str | None,
    typer.Option(
        metavar="SPLIT",
        help="Hold out the test responses of this split, in place of a share of pairs: as in nafir-train benchmark.",
    ),
]
Latency = Annotated[
    int,
    typer.Option(
        min=-_MOST_LATENCY_SAMPLES,
        max=_MOST_LATENCY_SAMPLES,
        help="Delay of the equipment to remove, in samples at the source's rate.",
    ),
]
Rate = Annotated[
    int | None,
    typer.Option(
        "--sample-rate",
        min=LOWEST_RATE_HZ,
        max=HIGHEST_RATE_HZ,
        help="Resample to this, Hz; otherwise the rate is kept.",
    ),
]
Duration = Annotated[
    float | None,
    typer.Option(
        "--duration-s", min=0.001, max=MOST_SAMPLES / LOWEST_RATE_HZ, help="Longest response; all of it otherwise."
    ),
]
Scale = Annotated[
    float,
    typer.Option(min=1e-6, max=1e6, help="Multiplies positions: metres in their unit, 0.001 for millimetres."),
]
Mirror = Annotated[Axis | None, typer.Option(help="Axis whose coordinates change sign.")]
SwapEars = Annotated[bool, typer.Option("--swap-ears", help="The second channel is the left ear.")]
AcceptEars = Annotated[bool, typer.Option("--accept-ears", help="Import all the same where ears contradict positions.")]


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
    position_scale: Scale = 1.0,
    mirror: Mirror = None,
    swap_ears: SwapEars = False,
    accept_ears: AcceptEars = False,
    split: Split = None,
    as_json: Json = False,
) -> None:
    """A scene of SoundSpaces 1.0: points.txt and <azimuth>/<receiver>_<source>.wav, binaural."""
    from training.data.importers.soundspaces import read

    conditioning = _conditioning(
        latency_samples, sample_rate, duration_s, position_scale, mirror, swap_ears=swap_ears, accept_ears=accept_ears
    )
    _import(
        "soundspaces",
        source,
        output,
        conditioning,
        partial(read, points=points),
        held_out=held_out,
        seed=seed,
        split=_Split(split, points=points),
        as_json=as_json,
    )


@importing.command("meshrir")
def import_meshrir(
    source: Source,
    output: Output,
    source_rate: Annotated[
        int, typer.Option(min=4_000, max=768_000, help="Rate of the arrays, which do not tell it.")
    ] = 48_000,
    held_out: HeldOut = 0.1,
    seed: Seed = 0,
    latency_samples: Latency = 0,
    sample_rate: Rate = None,
    duration_s: Duration = None,
    position_scale: Scale = 1.0,
    mirror: Mirror = None,
    split: Split = None,
    as_json: Json = False,
) -> None:
    """A room of MeshRIR: pos_mic.npy, pos_src.npy and ir_<microphone>.npy, one channel."""
    from training.data.importers.meshrir import read

    conditioning = _conditioning(latency_samples, sample_rate, duration_s, position_scale, mirror)
    _import(
        "meshrir",
        source,
        output,
        conditioning,
        partial(read, source_rate=source_rate),
        held_out=held_out,
        seed=seed,
        split=_Split(split),
        as_json=as_json,
    )


@importing.command("raf")
def import_raf(
    source: Source,
    output: Output,
    held_out: HeldOut = 0.1,
    seed: Seed = 0,
    latency_samples: Latency = 0,
    sample_rate: Rate = None,
    duration_s: Duration = None,
    position_scale: Scale = 1.0,
    mirror: Mirror = None,
    split: Split = None,
    as_json: Json = False,
) -> None:
    """A room of Real Acoustic Fields: rir.wav, rx_pos.txt and tx_pos.txt in numbered folders, one channel."""
    from training.data.importers.raf import read

    conditioning = _conditioning(latency_samples, sample_rate, duration_s, position_scale, mirror)
    _import(
        "raf",
        source,
        output,
        conditioning,
        read,
        held_out=held_out,
        seed=seed,
        split=_Split(split),
        as_json=as_json,
    )


@importing.command("acousticrooms")
def import_acousticrooms(
    source: Source,
    output: Output,
    room: Annotated[str, typer.Option(help="Which room, kind/room, where the folder has several.")] = "",
    held_out: HeldOut = 0.1,
    seed: Seed = 0,
    latency_samples: Latency = 0,
    sample_rate: Rate = None,
    duration_s: Duration = None,
    position_scale: Scale = 1.0,
    mirror: Mirror = None,
    split: Split = None,
    as_json: Json = False,
) -> None:
    """One room of AcousticRooms: single_channel_ir/<kind>/<room>/S<source>_R<receiver>_hybrid_IR.wav, one channel."""
    from training.data.importers.acousticrooms import read

    conditioning = _conditioning(latency_samples, sample_rate, duration_s, position_scale, mirror)
    _import(
        "acousticrooms",
        source,
        output,
        conditioning,
        partial(read, room=room),
        held_out=held_out,
        seed=seed,
        split=_Split(split),
        as_json=as_json,
    )


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
    position_scale: Scale = 1.0,
    mirror: Mirror = None,
    swap_ears: SwapEars = False,
    accept_ears: AcceptEars = False,
    as_json: Json = False,
) -> None:
    """A SOFA file of a room: SingleRoomSRIR, SingleRoomMIMOSRIR, MultiSpeakerBRIR, or binaural SimpleFreeFieldHRIR."""
    from training.data.importers.sofa import read

    conditioning = _conditioning(
        latency_samples, sample_rate, duration_s, position_scale, mirror, swap_ears=swap_ears, accept_ears=accept_ears
    )
    _import(
        "sofa",
        source,
        output,
        conditioning,
        partial(read, receivers=receivers, checks_ears=not (swap_ears or accept_ears or mirror)),
        held_out=held_out,
        seed=seed,
        as_json=as_json,
    )


def _conditioning(
    latency_samples: int,
    sample_rate: int | None,
    duration_s: float | None,
    position_scale: float,
    mirror: Axis | None,
    *,
    swap_ears: bool = False,
    accept_ears: bool = False,
) -> "Conditioning":
    from training.data.importers.conditioning import Conditioning

    axis: Literal["x", "y"] | None = None if mirror is None else mirror.value
    return Conditioning(latency_samples, sample_rate, duration_s, position_scale, axis, swap_ears, accept_ears)


@dataclass(frozen=True)
class _Split:
    """A split that was asked for, and what the layout has to be told to list its responses."""

    asked: str | None = None
    points: Path | None = None

    def apply(
        self, named: Iterable[tuple[str, "Measurement"]], layout: str, source: Path, report: "ImportReport"
    ) -> Iterable[tuple[str, "Measurement"]]:
        """The measurements of the split's two parts, with the mark of their part; others are skipped."""
        if self.asked is None:
            yield from named
            return
        from training.data.importers.layouts import LAYOUTS, Options
        from training.data.importers.report import ImportReport

        entries = LAYOUTS[layout].entries(source, ImportReport(), Options(points=self.points))
        split = LAYOUTS[layout].split_of(source, entries, self.asked)
        report.note(f"held out: the test responses of the split {split.name} ({split.source})")
        for name, measurement in named:
            role = split.role(measurement.name)
            if role in {"train", "test"}:
                yield name, replace(measurement, held_out=role == "test")
            else:
                report.skip(name, f"of the split's {role} part" if role else "not in the split")


def _import(
    layout: str,
    source: Path,
    output: Path,
    conditioning: "Conditioning",
    read: Callable[..., Generator[tuple[str, "Measurement"]]],
    *,
    held_out: float,
    seed: int,
    as_json: bool,
    split: _Split = _Split(),
) -> None:
    from training.data.importers.conditioning import SourceError, condition, within_limits
    from training.data.importers.report import ImportReport
    from training.data.responses import ImportedDataset

    if not source.exists():
        raise SourceError(source, "source", "no such file or folder")
    console = Console(stderr=True)

    def tracked(items: Sequence[_T]) -> Iterable[_T]:
        return track(items, f"importing {layout}", console=console)

    report = ImportReport()
    # Closed at once if the import fails: otherwise the progress bar would be drawn after the message.
    with closing(read(source, report, track=tracked)) as named:
        measurements = condition(split.apply(named, layout, source, report), conditioning, report, source=source)
        dataset = ImportedDataset.write(
            output,
            within_limits(measurements, source),
            report,
            layout=layout,
            source=str(source),
            held_out_share=held_out,
            seed=seed,
        )
    pairs, of_pairs = len(set(dataset.pair)), len(set(dataset.pair[dataset.held_out]))
    if as_json:
        summary = {
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
        typer.echo(json.dumps(summary, indent=2))
        return
    Console(width=None if console.is_terminal else 140).print(report.table())
    typer.echo(
        f"{output}: {pairs - of_pairs} pairs to train on and {of_pairs} held out, "
        f"{dataset.channels} channel{'s' if dataset.channels > 1 else ''} of {dataset.samples} samples "
        f"at {dataset.sample_rate} Hz"
    )
