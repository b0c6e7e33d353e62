"""The run folder: `run.json` (configuration), `dataset.json` (which data, and where), `checkpoint.pt` (everything
needed to resume), `log.csv` and `tensorboard/`."""

import csv
import dataclasses
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from server.core.errors import NafirError
from training.data.responses import ResponseSet
from training.learning.record import RECIPE_EPOCHS, RECIPE_POINTS, TrainingRecord, slope_per_doubling
from training.models.encoders import FieldShape
from training.models.naf import NafShape
from training.simulation.responses import SimulatedResponses

CHECKPOINT = "checkpoint.pt"
LOG = "log.csv"
GRID_FEATURES = 64
"""Learned features of a place, of a directional field: with half of them, levels and clarity are less accurate."""
_MOST_STEPS = 400
"""In an epoch of a directional field. With twice as many pairs in each, its errors are as small and an epoch takes two
thirds of the time."""
_FIELD_NAMES = {"lessons": "distilled_poses"}
"""Fields of a recipe that have another name in `run.json`."""


class RunError(NafirError):
    """The error for a run folder that has another configuration, or no trained field."""


class RecipeError(NafirError):
    """The error for training options that do not fit the data."""


@dataclass(frozen=True)
class FactorisedRecipe:
    """How a factorised field is trained. Options that are off by default did not improve errors where that was
    measured.

    `fine_frames`: number of frames that are predicted bin by bin, before cells. `level_correction`: correct the gap
    between a mean of logarithms and the logarithm of a mean power. `energy_weight`: weight of the error of energies
    (`training.learning.energies`). `swap`: also train on responses with listener and emitter exchanged, which are the
    same if both are omnidirectional (one channel only). `expected`: train on expected values in place of random draws
    (simulated responses only). `teacher`: run folder of a `naf` whose predicted levels are distilled, at
    `distilled_poses` poses between the measured ones.
    """

    fine_frames: int = 24
    level_correction: bool = True
    energy_weight: float = 3.0
    swap: bool = False
    expected: bool = True
    teacher: str | None = None
    distilled_poses: int = 256


@dataclass(frozen=True)
class DirectionalRecipe:
    """How a directional field is trained. `order`: highest order of its spherical harmonics, 0 to 3. `fine_frames`:
    number of frames that are predicted one by one, before cells. `energy_weight`: weight of the error of energies
    (`training.learning.energies`). `noise_m`: standard deviation of noise that is added to positions. `reciprocal`:
    learn the mean power of a pair and of the pair with exchanged ends, which differ only by the randomness of rays. If
    doors stand otherwise for the latter, the power is known one way only, and is learned as that of both, by turns.
    In levels whose doors move, a pair is known with the doors in one state only, and a network soon learns most of them
    by heart. There, `dropout` is the share of each hidden layer's features that a step leaves out, and `openness_noise`
    the standard deviation of noise that is added to how far a door is open that stands half open. Others have less:
    near shut, little changes much."""

    order: int = 2
    fine_frames: int = 24
    energy_weight: float = 3.0
    noise_m: float = 0.1
    reciprocal: bool = True
    dropout: float = 0.2
    openness_noise: float = 0.05


@dataclass(frozen=True)
class NafRecipe:
    """How the paper's network is trained. `points`: points of each response per step. `noise_m`: standard deviation of
    noise that is added to positions. `padding`: probability that the silence after a response's end is trained on.
    `phase_weight`: weight of the error of instantaneous frequency (the paper's alpha, whose value it does not state).
    `whole`: train on responses with the direct sound and first reflections, as the paper does, not on late
    reverberation only (simulated scenes). `expected`: train on expected values, as a factorised field does, and not on
    random draws, as the paper does (simulated scenes)."""

    points: int = 2000
    noise_m: float = 0.1
    padding: float = 0.1
    phase_weight: float = 0.1
    whole: bool = False
    expected: bool = False


@dataclass(frozen=True)
class Configuration:
    """Everything besides the dataset that decides the result of a run.

    Training lasts for `minutes` of the processor if given (of the clock on a GPU), else for `epochs`. With `patience`
    it stops after this many rounds (epochs, or twentieths of the time) without a smaller validation error, and the
    field with the smallest error is kept. Without it the last field is kept, for which the learning rate is scheduled.
    `share` is the share of the training pairs that is used. A step takes `batch` examples, or twice, three times, ...
    as many, so that an epoch has no more than `most_steps`: more examples at a time cost less each."""

    seed: int = 0
    epochs: int = 8
    minutes: float | None = None
    share: float = 1.0
    batch: int = 128
    most_steps: int | None = None
    learning_rate: float = 2e-3
    patience: int | None = None
    shape: FieldShape | NafShape = dataclasses.field(default_factory=FieldShape)
    recipe: FactorisedRecipe | DirectionalRecipe | NafRecipe = dataclasses.field(default_factory=FactorisedRecipe)

    @classmethod
    def naf(cls, shape: NafShape, recipe: NafRecipe | None = None, **changes: Any) -> "Configuration":
        """The paper's settings: 200 epochs, 20 responses per step."""
        settings = {"epochs": 200, "batch": 20, "learning_rate": 5e-4, **changes}
        return cls(shape=shape, recipe=recipe or NafRecipe(), **settings)

    @classmethod
    def directional(
        cls, shape: FieldShape | None = None, recipe: DirectionalRecipe | None = None, **changes: Any
    ) -> "Configuration":
        """An epoch visits each pair once and not at every yaw, so there are more of them."""
        settings = {"epochs": 100, "batch": 32, "most_steps": _MOST_STEPS, **changes}
        return cls(
            shape=shape or FieldShape(grid_features=GRID_FEATURES), recipe=recipe or DirectionalRecipe(), **settings
        )

    def examples_of_a_step(self, examples: int) -> int:
        """The least multiple of the batch with which an epoch of so many examples has no more than the most steps."""
        if self.most_steps is None:
            return self.batch
        return self.batch * max(1, math.ceil(examples / (self.batch * self.most_steps)))

    @property
    def kind(self) -> Literal["factorised", "directional", "naf"]:
        if isinstance(self.shape, NafShape):
            return "naf"
        return "directional" if isinstance(self.recipe, DirectionalRecipe) else "factorised"

    @property
    def name(self) -> str:
        """Kind and variant, as on the command line."""
        if not isinstance(self.shape, NafShape):
            return self.kind
        if self.shape.domain == "time":
            return "naf-time-domain"
        if isinstance(self.recipe, NafRecipe) and self.recipe.whole:
            return "naf-whole"
        if isinstance(self.recipe, NafRecipe) and self.recipe.expected:
            return "naf-expected"
        return {"shared": "naf", "dual": "naf-dual", "none": "naf-no-grid"}[self.shape.grid]

    @classmethod
    def read(cls, run: Path) -> "Configuration":
        """Read the configuration of a run. Raises RunError if the folder holds no run."""
        values = read_json(run, "run.json")
        try:
            shape_type, recipe_type = _KINDS[values.pop("kind")]
            shape = shape_type(**values.pop("shape"))
            recipe_values = {_FIELD_NAMES.get(name, name): value for name, value in values.pop("recipe").items()}
            recipe = recipe_type(**recipe_values)
            return cls(**values, shape=shape, recipe=recipe)
        except (KeyError, TypeError) as exc:
            raise RunError(f"{run / 'run.json'}: not a configuration: {exc}") from exc

    def write(self, run: Path) -> None:
        values = asdict(self)
        stored = {field: name for name, field in _FIELD_NAMES.items()}
        values["recipe"] = {stored.get(name, name): value for name, value in values["recipe"].items()}
        write_json(run / "run.json", {"kind": self.kind, **values})


_KINDS: dict[str, tuple[type[FieldShape | NafShape], type[FactorisedRecipe | DirectionalRecipe | NafRecipe]]] = {
    "factorised": (FieldShape, FactorisedRecipe),
    "directional": (FieldShape, DirectionalRecipe),
    "naf": (NafShape, NafRecipe),
}
_NAFS = {
    "naf": (NafShape(), NafRecipe()),
    "naf-whole": (NafShape(), NafRecipe(whole=True)),
    "naf-expected": (NafShape(), NafRecipe(expected=True)),
    "naf-dual": (NafShape(grid="dual"), NafRecipe()),
    "naf-no-grid": (NafShape(grid="none"), NafRecipe()),
    "naf-time-domain": (NafShape(domain="time"), NafRecipe()),
}
FIELDS = ("factorised", "directional", *_NAFS)


def configure(
    field: str,
    *,
    rank: int | None = None,
    width: int | None = None,
    order: int | None = None,
    points: int | None = None,
    teacher: Path | None = None,
    **changes: Any,
) -> Configuration:
    """The default configuration of the field with this name on the command line, with changes.

    Raises RunError for an unknown name, or for an option that this field does not have.
    """
    if changes.get("epochs") is not None and changes.get("minutes") is not None:
        raise RunError("epochs: a run has a length in epochs or in minutes; leave one out")
    if field not in FIELDS:
        raise RunError(f"field: there is no {field!r}, but {', '.join(FIELDS)}")
    if order is not None and field != "directional":
        raise RunError(f"order: only a directional field has one; leave it out for {field}")
    if teacher is not None and field != "factorised":
        raise RunError(f"teacher: only a factorised field has one; leave it out for {field}")
    if field in ("factorised", "directional"):
        if points is not None:
            raise RunError(f"points: a {field} field is trained on whole responses; leave it out")
        chosen = {"rank": rank, "width": width}
        if field == "directional":
            chosen["grid_features"] = GRID_FEATURES
        shape = FieldShape(**{option: value for option, value in chosen.items() if value is not None})
        if field == "directional":
            recipe = DirectionalRecipe() if order is None else DirectionalRecipe(order=order)
            return Configuration.directional(shape, recipe, **changes)
        taught = FactorisedRecipe(teacher=None if teacher is None else str(teacher.resolve()))
        return Configuration(shape=shape, recipe=taught, **changes)
    for option, value in (("rank", rank), ("width", width)):
        if value is not None:
            raise RunError(f"{option}: only a factorised or directional field has one; leave it out for {field}")
    naf_shape, naf_recipe = _NAFS[field]
    if points is not None:
        naf_recipe = dataclasses.replace(naf_recipe, points=points)
    return Configuration.naf(naf_shape, naf_recipe, **changes)


def dataset_folder(run: Path) -> Path:
    """The folder of the dataset that a run was trained on. Raises RunError if the folder holds no run."""
    return Path(read_json(run, "dataset.json")["folder"])


def claim(run: Path, responses: ResponseSet, configuration: Configuration) -> None:
    """Make the folder a run of this configuration on these data, if it is not one already.

    Raises RunError if the folder holds a run of another configuration or on other data.
    """
    run.mkdir(parents=True, exist_ok=True)
    if (run / "run.json").exists():
        if Configuration.read(run) != configuration:
            raise RunError(f"{run}: holds a run of another configuration; choose an empty folder")
        require_same_data(responses, run)
    identity = {"folder": str(responses.file.parent.resolve()), **_identity(responses)}
    write_json(run / "dataset.json", identity)
    configuration.write(run)


def require_same_data(responses: ResponseSet, run: Path) -> None:
    """Check that the run was trained on these data. Raises RunError if not."""
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
    """Write the checkpoint so that an interruption leaves the previous one whole."""
    # guard: checkpoints are written whole
    partial = run / "checkpoint.partial"
    torch.save(state, partial)
    partial.replace(run / CHECKPOINT)


def load_checkpoint(run: Path, device: torch.device) -> dict[str, Any]:
    """Load the checkpoint of a run. Raises RunError if there is none."""
    try:
        return dict(torch.load(run / CHECKPOINT, map_location=device, weights_only=True))
    except OSError as exc:
        raise RunError(f"{run}: holds no checkpoint: {exc.strerror}") from exc


def is_finished(run: Path) -> bool:
    """Whether a run is trained to its end. Raises RunError if there is no checkpoint."""
    return bool(load_checkpoint(run, torch.device("cpu"))["finished"])


def restore(field: torch.nn.Module, run: Path, configuration: Configuration) -> None:
    """Load the parameters of a finished run into the field. Raises RunError if the run is unfinished, or of another
    network."""
    state = load_checkpoint(run, torch.device("cpu"))
    # guard: an unfinished run is no field
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
    """Minutes that a finished run took, preparation included. Raises RunError if it is unfinished."""
    state = load_checkpoint(run, torch.device("cpu"))
    if not state["finished"]:
        raise RunError(f"{run}: is not finished; run train again")
    return float(round((state["seconds"] + state["prepared_s"]) / 60, 3))


def record_of(run: Path) -> TrainingRecord:
    """How far a run was trained. Raises RunError if there is none."""
    configuration = Configuration.read(run)
    state = load_checkpoint(run, torch.device("cpu"))
    recipe, patience = configuration.recipe, configuration.patience
    curve = [(int(step), float(loss)) for step, loss in state.get("curve", [])]
    losses = [loss for _, loss in curve]
    points, share = None, None
    if isinstance(recipe, NafRecipe):
        points = int(state.get("responses", 0)) * recipe.points
        share = float(state["epochs"] * configuration.share * recipe.points / (RECIPE_EPOCHS * RECIPE_POINTS))
    return TrainingRecord(
        field=configuration.name,
        epochs=float(state["epochs"]),
        steps=int(state["step"]),
        points=points,
        recipe_share=share,
        held_back_loss=(losses[-1] if patience is None else min(losses)) if losses else None,
        mean_loss=state.get("mean_loss"),
        slope_per_doubling=slope_per_doubling(curve),
        patience=patience,
        stopped=patience is not None and state["stale"] >= patience,
    )


def keep_log(run: Path, rounds: int) -> None:
    """Cut the log to the `rounds` that the checkpoint has; later rounds will be written again."""
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


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write the file so that an interruption leaves the previous one whole."""
    # guard: what a run is, is written whole
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(document, indent=2) + "\n")
    partial.replace(path)


def require_still_doors(responses: ResponseSet, kind: str) -> None:
    """Raise RecipeError for a level whose doors move, if fields of this kind do not know how far they are open."""
    if isinstance(responses, SimulatedResponses) and responses.dataset.doors:
        raise RecipeError(f"field: the doors of this level move, and {kind} is not told of them: train directional")


def _identity(responses: ResponseSet) -> dict[str, Any]:
    """Facts that identify the data, wherever they are stored."""
    if isinstance(responses, SimulatedResponses):
        return {"seed": responses.dataset.seed, "scene": responses.dataset.place.identity}
    ends = np.concatenate([responses.listener, responses.emitter, responses.yaw[:, None]], axis=1)
    return {
        "sample_rate": responses.sample_rate,
        "samples": responses.samples,
        "channels": responses.channels,
        "rows": len(ends),
        "sum_of_poses": round(float(ends.sum()), 6),
        "held_out": int(responses.held_out.sum()),
    }
