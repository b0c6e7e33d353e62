"""Trains the paper's network until its error on held-back pairs has stopped falling, in pieces of a given time:
`python -m training.trials.networks_to_the_end RUNS --minutes 14`.

One scene has the network and its variants, the other scenes the network as it is and on whole responses. Missing
datasets are simulated. Each call goes on where the one before stopped, on whatever machine: copy RUNS, and the datasets
with it or not. Unfinished networks have equal shares of the time that is left. At the end, RUNS/networks.json and a
list say how far each network is, with the curve of its loss.

On a GPU all points of the paper's recipe are affordable. Without one, give fewer (`--points 100`).
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import Progress

from training.learning.record import TrainingRecord
from training.learning.runs import CHECKPOINT, configure, load_checkpoint, record_of
from training.learning.train import train
from training.parallel.jobs import ALL_CORES
from training.simulation.responses import open_responses
from training.simulation.run import simulate

SCENES = Path(__file__).parents[1] / "scenes"
VARIANTS = ("naf", "naf-expected", "naf-dual", "naf-no-grid", "naf-time-domain")
EVERYWHERE = ("naf", "naf-expected", "naf-whole")
SIX = ("small1", "small2", "medium1", "medium2", "large1", "large2")
PATIENCE = 10
RESULT = "networks.json"


@dataclass(frozen=True)
class Job:
    """The training of one network on one scene."""

    scene: str
    field: str

    def run(self, runs: Path) -> Path:
        return runs / self.scene / self.field


def jobs(scenes: Sequence[str]) -> list[Job]:
    """The variants on the first scene, then the others' networks; the network as it is everywhere comes first."""
    first, *others = scenes
    everywhere = [Job(scene, field) for field in EVERYWHERE for scene in scenes]
    variants = [Job(first, field) for field in VARIANTS if field not in EVERYWHERE]
    return [
        *[job for job in everywhere if job.scene == first],
        *variants,
        *[job for job in everywhere if job.scene in others],
    ]


def is_finished(run: Path) -> bool:
    return (run / CHECKPOINT).is_file() and bool(load_checkpoint(run, torch.device("cpu"))["finished"])


def train_some(
    chosen: Sequence[Job], runs: Path, *, seconds: float, epochs: int, patience: int, points: int, progress: Progress
) -> Iterator[tuple[Job, bool]]:
    """Train each unfinished network for its share of the seconds; yields it, and whether it is finished now."""
    ends_s = time.monotonic() + seconds
    waiting = [job for job in chosen if not is_finished(job.run(runs))]
    for number, job in enumerate(waiting):
        share_s = (ends_s - time.monotonic()) / (len(waiting) - number)
        if share_s <= 0:
            return
        began_s = time.monotonic()
        data = runs / job.scene / "data"
        simulate(SCENES / f"{job.scene}.toml", data, seed=0, jobs=ALL_CORES, progress=progress)
        configuration = configure(job.field, epochs=epochs, patience=patience, points=points)
        left_s = share_s - (time.monotonic() - began_s)
        yield job, train(open_responses(data), job.run(runs), configuration, progress, pause_after_s=left_s)


def records(chosen: Sequence[Job], runs: Path) -> dict[str, dict[str, TrainingRecord]]:
    """How far the networks that were begun are, by scene and field."""
    found: dict[str, dict[str, TrainingRecord]] = {}
    for job in chosen:
        if (job.run(runs) / CHECKPOINT).is_file():
            found.setdefault(job.scene, {})[job.field] = record_of(job.run(runs))
    return found


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m training.trials.networks_to_the_end")
    parser.add_argument("runs", type=Path)
    parser.add_argument("--minutes", type=float, required=True, help="of the clock, for this call")
    parser.add_argument("--scenes", default=",".join(SIX), help="the first one has the variants too")
    parser.add_argument("--epochs", type=int, default=200)
    parser.add_argument("--patience", type=int, default=PATIENCE)
    parser.add_argument("--points", type=int, default=2000)
    asked = parser.parse_args(arguments)
    chosen = jobs(asked.scenes.split(","))
    with Progress(console=Console(stderr=True)) as progress:
        for job, finished in train_some(
            chosen,
            asked.runs,
            seconds=60 * asked.minutes,
            epochs=asked.epochs,
            patience=asked.patience,
            points=asked.points,
            progress=progress,
        ):
            sys.stderr.write(f"{job.scene} {job.field}: {'finished' if finished else 'to be continued'}\n")
    found = records(chosen, asked.runs)
    document = {
        scene: {field: asdict(record) for field, record in of_scene.items()} for scene, of_scene in found.items()
    }
    for job in chosen:
        if job.field in found.get(job.scene, {}):
            state = load_checkpoint(job.run(asked.runs), torch.device("cpu"))
            document[job.scene][job.field] |= {"finished": state["finished"], "curve": state["curve"]}
    (asked.runs / RESULT).write_text(json.dumps(document, indent=1) + "\n")
    for scene, of_scene in found.items():
        for field, record in of_scene.items():
            sys.stdout.write(f"{scene} {field}: {record.sentence()}\n")
    return 0 if all(is_finished(job.run(asked.runs)) for job in chosen) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
