"""The run folder: `run.json` (configuration), `dataset.json` (what the data are and where they lie), `checkpoint.pt`
(everything needed to go on), `log.csv` and `tensorboard/`.
"""

import csv
import dataclasses
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from server.core.errors import NafirError
from training.data.responses import ResponseSet, SimulatedResponses
from training.models.factorised import FieldShape
from training.models.naf import NafShape

CHECKPOINT = "checkpoint.pt"
LOG = "log.csv"


class RunError(NafirError):
    """A run folder that holds another configuration, or no trained field."""


class RecipeError(NafirError):
    """A way of training that does not fit the data."""


@dataclass(frozen=True)
class FactorisedRecipe:
    """How a factorised field is trained. Those that are off did not pay where they were measured.

    `fine_frames` are predicted bin by bin, later ones in cells; `level_correction` adds what a mean of logarithms lacks
    to a mean of powers; `energy_weight` is that of the error in energies (`training.learning.energies`); `swap` also
    shows every response with its ends exchanged, which is the same response where both are omnidirectional: one channel
    only; `expected` trains on what is expected of a simulated response in place of what was drawn (measured ones are
    what they are). `teacher` is the run folder of a `naf` that is asked for the levels of responses at `lessons` poses
    of its own.
    """

    fine_frames: int = 24
    level_correction: bool = True
    energy_weight: float = 3.0
    swap: bool = False
    expected: bool = True
    teacher: str | None = None
    lessons: int = 256


@dataclass(frozen=True)
class NafRecipe:
    """How the paper's network is trained: `points` of each response per step, positions shaken by `noise_m` (standard
    deviation), silence after a response's end shown with probability `padding`, and `phase_weight` (the paper's alpha,
    which it does not state) of the error in instantaneous frequency. `whole` are, as in the
    paper, responses of simulated scenes with the direct sound and the first reflections, else left to geometry."""

    points: int = 2000
    noise_m: float = 0.1
    padding: float = 0.1
    phase_weight: float = 0.1
    whole: bool = False


@dataclass(frozen=True)
class Configuration:
    """All that decides a run's outcome besides the dataset.

    Trained for `minutes` of computing if given, else for `epochs`. With `patience` training stops after so many rounds
    (an epoch, or a twentieth of the time) without a smaller error on what is held back, and the field of the smallest
    is kept; without, the last one, for which learning rates are scheduled. `share` is that of the training pairs used.
    """

    seed: int = 0
    epochs: int = 8
    minutes: float | None = None
    share: float = 1.0
    batch: int = 128
    learning_rate: float = 2e-3
    patience: int | None = None
    shape: FieldShape | NafShape = dataclasses.field(default_factory=FieldShape)
    recipe: FactorisedRecipe | NafRecipe = dataclasses.field(default_factory=FactorisedRecipe)

    @classmethod
    def naf(cls, shape: NafShape, recipe: NafRecipe | None = None, **changes: Any) -> "Configuration":
        """The paper's: 200 epochs of 20 responses a step."""
        settings = {"epochs": 200, "batch": 20, "learning_rate": 5e-4, **changes}
        return cls(shape=shape, recipe=recipe or NafRecipe(), **settings)

    @property
    def kind(self) -> Literal["factorised", "naf"]:
        return "naf" if isinstance(self.shape, NafShape) else "factorised"

    @property
    def name(self) -> str:
        """The kind and variant as the command line says it."""
        if not isinstance(self.shape, NafShape):
            return self.kind
        if self.shape.domain == "time":
            return "naf-time-domain"
        if isinstance(self.recipe, NafRecipe) and self.recipe.whole:
            return "naf-whole"
        return {"shared": "naf", "dual": "naf-dual", "none": "naf-no-grid"}[self.shape.grid]

    @classmethod
    def read(cls, run: Path) -> "Configuration":
        """Raises RunError if the folder holds no run."""
        values = read_json(run, "run.json")
        try:
            naf = values.pop("kind") == "naf"
            shape = (NafShape if naf else FieldShape)(**values.pop("shape"))
            recipe = (NafRecipe if naf else FactorisedRecipe)(**values.pop("recipe"))
            return cls(**values, shape=shape, recipe=recipe)
        except (KeyError, TypeError) as exc:
            raise RunError(f"{run / 'run.json'}: not a configuration: {exc}") from exc

    def write(self, run: Path) -> None:
        _write_whole(run / "run.json", {"kind": self.kind, **asdict(self)})


_NAFS = {
    "naf": (NafShape(), NafRecipe()),
    "naf-whole": (NafShape(), NafRecipe(whole=True)),
    "naf-dual": (NafShape(grid="dual"), NafRecipe()),
    "naf-no-grid": (NafShape(grid="none"), NafRecipe()),
    "naf-time-domain": (NafShape(domain="time"), NafRecipe()),
}
FIELDS = ("factorised", *_NAFS)


def configure(
    field: str,
    *,
    rank: int | None = None,
    width: int | None = None,
    points: int | None = None,
    teacher: Path | None = None,
    **changes: Any,
) -> Configuration:
    """The usual configuration of a field by its name on the command line, changed as said.

    Raises RunError for another name, or for an option that this field has not.
    """
    if field not in FIELDS:
        raise RunError(f"field: there is no {field!r}, but {', '.join(FIELDS)}")
    if field == "factorised":
        if points is not None:
            raise RunError("points: a factorised field is trained on whole responses; leave it out")
        chosen = {"rank": rank, "width": width}
        shape = FieldShape(**{option: value for option, value in chosen.items() if value is not None})
        recipe = FactorisedRecipe(teacher=None if teacher is None else str(teacher.resolve()))
        return Configuration(shape=shape, recipe=recipe, **changes)
    for option, value in (("rank", rank), ("width", width), ("teacher", teacher)):
        if value is not None:
            raise RunError(f"{option}: only a factorised field has one; leave it out for {field}")
    naf_shape, naf_recipe = _NAFS[field]
    if points is not None:
        naf_recipe = dataclasses.replace(naf_recipe, points=points)
    return Configuration.naf(naf_shape, naf_recipe, **changes)


def dataset_folder(run: Path) -> Path:
    """The dataset a run was trained on. Raises RunError if the folder holds no run."""
    return Path(read_json(run, "dataset.json")["folder"])


def claim(run: Path, responses: ResponseSet, configuration: Configuration) -> None:
    """Makes the folder this configuration's run on these data, if it is not already.

    Raises RunError if the folder holds a run of another configuration or on other data.
    """
    run.mkdir(parents=True, exist_ok=True)
    if (run / "run.json").exists():
        if Configuration.read(run) != configuration:
            raise RunError(f"{run}: holds a run of another configuration; choose an empty folder")
        require_same_data(responses, run)
    identity = {"folder": str(responses.file.parent.resolve()), **_identity(responses)}
    _write_whole(run / "dataset.json", identity)
    configuration.write(run)


def require_same_data(responses: ResponseSet, run: Path) -> None:
    """Raises RunError if the run was trained on others."""
    recorded = read_json(run, "dataset.json")
    identity = _identity(responses)
    if {name: recorded.get(name) for name in identity} != identity:
        raise RunError(f"{run}: was trained on another scene or seed than that of {responses.file.parent}")


def read_json(run: Path, name: str) -> dict[str, Any]:
    try:
        return dict(json.loads((run / name).read_text()))
    except OSError as exc:
        raise RunError(f"{run}: not a run folder: {name}: {exc.strerror}") from exc
    except ValueError as exc:
        raise RunError(f"{run / name}: not JSON: {exc}") from exc


def save_checkpoint(run: Path, state: dict[str, Any]) -> None:
    """An interrupt in the middle of writing leaves the previous checkpoint whole."""
    partial = run / "checkpoint.partial"
    torch.save(state, partial)
    partial.replace(run / CHECKPOINT)


def load_checkpoint(run: Path, device: torch.device) -> dict[str, Any]:
    """Raises RunError if there is none."""
    try:
        return dict(torch.load(run / CHECKPOINT, map_location=device, weights_only=True))
    except OSError as exc:
        raise RunError(f"{run}: holds no checkpoint: {exc.strerror}") from exc


def restore(field: torch.nn.Module, run: Path, configuration: Configuration) -> None:
    """Gives the field what a finished run learned. Raises RunError if the run is unfinished, or of another network."""
    state = load_checkpoint(run, torch.device("cpu"))
    if not state["finished"]:
        length = (
            f"{state['epochs']:.3g} of {configuration.epochs} epochs"
            if configuration.minutes is None
            else f"{state['seconds'] / 60:.1f} of {configuration.minutes:g} minutes"
        )
        raise RunError(f"{run}: {length} are trained; run train again")
    try:
        field.load_state_dict(state["field"])
    except RuntimeError as exc:
        raise RunError(f"{run}: was trained by another version of this program; train again") from exc
    field.eval()


def minutes_of(run: Path) -> float:
    """How long a finished run took, preparing included. Raises RunError if it is unfinished."""
    state = load_checkpoint(run, torch.device("cpu"))
    if not state["finished"]:
        raise RunError(f"{run}: is not finished; run train again")
    return float(round((state["seconds"] + state["prepared_s"]) / 60, 3))


def keep_log(run: Path, rounds: int) -> None:
    """The first rounds of the log, as many as the checkpoint knows: what was written after it will be again."""
    path = run / LOG
    if not rounds:
        path.unlink(missing_ok=True)
    elif path.exists():
        partial = path.with_suffix(".partial")
        partial.write_text("".join(path.read_text().splitlines(keepends=True)[: 1 + rounds]))
        partial.replace(path)


def append_log(run: Path, row: dict[str, float]) -> None:
    path = run / LOG
    fresh = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if fresh:
            writer.writeheader()
        writer.writerow({name: f"{value:.6g}" for name, value in row.items()})


def _write_whole(path: Path, document: dict[str, Any]) -> None:
    """An interrupt in the middle of writing leaves what was there before."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(document, indent=2) + "\n")
    partial.replace(path)


def _identity(responses: ResponseSet) -> dict[str, Any]:
    """What makes data the same wherever they lie."""
    if isinstance(responses, SimulatedResponses):
        return {"seed": responses.dataset.seed, "scene": responses.dataset.scene.model_dump(mode="json")}
    ends = np.concatenate([responses.listener, responses.emitter, responses.yaw[:, None]], axis=1)
    return {
        "sample_rate": responses.sample_rate,
        "samples": responses.samples,
        "channels": responses.channels,
        "rows": len(ends),
        "sum_of_poses": round(float(ends.sum()), 6),
        "held_out": int(responses.held_out.sum()),
    }
