"""Training of a factorised field: resumable epoch by epoch, the same for the same seed and number of threads.

The run folder holds `run.json` (configuration), `dataset.json` (what the data are and where they lie), `checkpoint.pt`
(everything needed to go on), `log.csv` and the cached targets.
"""

import csv
import dataclasses
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import Progress
from torch import Tensor

from server.errors import NafirError
from training.dataset import Dataset
from training.models.cells import Cells
from training.models.factorised import FactorisedField, FieldShape
from training.models.targets import Targets, codec_of, load_targets

# What a target differs by from the best possible prediction (ln magnitude of one noisy bin, of a pooled cell; unit
# phasors): errors are measured in these, so that every head's loss starts to matter at the same distance from its
# floor.
_SPREADS = {"fine": 0.64, "late": 0.25, "phasor": 1.0, "interaural": 1.0}
_HEAD_WEIGHTS = {"fine": 1.0, "late": 1.0, "phasor": 2.0, "interaural": 1.0}
_SAMPLE_ROWS = 3000
_VALIDATION_SHARE = 0.05


class RunError(NafirError):
    """A run folder that holds another configuration, or no trained field."""


@dataclass(frozen=True)
class Configuration:
    """All that decides a run's outcome besides the dataset."""

    seed: int = 0
    epochs: int = 14
    batch: int = 128
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    shape: FieldShape = dataclasses.field(default_factory=FieldShape)

    @classmethod
    def read(cls, run: Path) -> "Configuration":
        """Raises RunError if the folder holds no run."""
        values = _read_json(run, "run.json")
        try:
            return cls(**{**values, "shape": FieldShape(**values["shape"])})
        except (KeyError, TypeError) as exc:
            raise RunError(f"{run / 'run.json'}: not a configuration: {exc}") from exc


def dataset_folder(run: Path) -> Path:
    """The dataset a run was trained on. Raises RunError if the folder holds no run."""
    return Path(_read_json(run, "dataset.json")["folder"])


def train(dataset: Dataset, run: Path, configuration: Configuration, progress: Progress) -> FactorisedField:
    """Trains to the end, from the last finished epoch if the run was interrupted.

    Raises RunError if the folder holds a run of another configuration or on another dataset.
    """
    run.mkdir(parents=True, exist_ok=True)
    if (run / "run.json").exists():
        if Configuration.read(run) != configuration:
            raise RunError(f"{run}: holds a run of another configuration; choose an empty folder")
        _require_same_data(dataset, run)
    identity = {"folder": str(dataset.folder.resolve()), **_identity(dataset)}
    (run / "dataset.json").write_text(json.dumps(identity, indent=2) + "\n")
    (run / "run.json").write_text(json.dumps(asdict(configuration), indent=2) + "\n")
    cells = Cells(codec_of(dataset))
    targets = load_targets(dataset, cells, run, progress)
    torch.manual_seed(configuration.seed)
    field = FactorisedField(dataset.plan, cells, configuration.shape)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    field.to(device)
    training_rows, validation_rows = _split(targets, configuration.seed)
    optimiser = torch.optim.AdamW(
        field.parameters(), configuration.learning_rate, weight_decay=configuration.weight_decay
    )
    steps = configuration.epochs * (len(training_rows) // _batch_size(configuration, training_rows))
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, configuration.learning_rate, steps, pct_start=0.1)
    checkpoint = run / "checkpoint.pt"
    first_epoch = 0
    if checkpoint.exists():
        state = torch.load(checkpoint, map_location=device, weights_only=True)
        field.load_state_dict(state["field"])
        optimiser.load_state_dict(state["optimiser"])
        schedule.load_state_dict(state["schedule"])
        first_epoch = state["epoch"]
    else:
        _initialise(field, targets, training_rows, configuration.seed)
    task = progress.add_task("training", total=configuration.epochs, completed=first_epoch)
    for epoch in range(first_epoch, configuration.epochs):
        losses = _train_epoch(field, optimiser, schedule, targets, training_rows, configuration, epoch)
        validation = _validate(field, targets, validation_rows, configuration.batch)
        if epoch + 1 == configuration.epochs:
            field.level_correction.copy_(_level_correction(field, targets, training_rows))
        _save(
            checkpoint,
            {
                "field": field.state_dict(),
                "optimiser": optimiser.state_dict(),
                "schedule": schedule.state_dict(),
                "epoch": epoch + 1,
            },
        )
        _log(run / "log.csv", {"epoch": epoch + 1, "training": losses, **validation})
        summary = " ".join(f"{name} {value:.4f}" for name, value in validation.items())
        progress.update(task, advance=1, description=f"training  held back: {summary}")
    return field


def load_field(dataset: Dataset, run: Path) -> tuple[FactorisedField, Cells, Configuration]:
    """The trained field of a finished run. Raises RunError if the run is missing, unfinished or of other data."""
    configuration = Configuration.read(run)
    _require_same_data(dataset, run)
    cells = Cells(codec_of(dataset))
    field = FactorisedField(dataset.plan, cells, configuration.shape)
    try:
        state = torch.load(run / "checkpoint.pt", map_location="cpu", weights_only=True)
    except OSError as exc:
        raise RunError(f"{run}: holds no checkpoint: {exc.strerror}") from exc
    if state["epoch"] < configuration.epochs:
        raise RunError(f"{run}: {state['epoch']} of {configuration.epochs} epochs are trained; run train again")
    field.load_state_dict(state["field"])
    return field.eval(), cells, configuration


def _read_json(run: Path, name: str) -> dict[str, Any]:
    try:
        return dict(json.loads((run / name).read_text()))
    except OSError as exc:
        raise RunError(f"{run}: not a run folder: {name}: {exc.strerror}") from exc
    except ValueError as exc:
        raise RunError(f"{run / name}: not JSON: {exc}") from exc


def _identity(dataset: Dataset) -> dict[str, Any]:
    """What makes data the same wherever they lie."""
    return {"seed": dataset.seed, "scene": dataset.scene.model_dump(mode="json")}


def _require_same_data(dataset: Dataset, run: Path) -> None:
    recorded = _read_json(run, "dataset.json")
    if {name: recorded.get(name) for name in ("seed", "scene")} != _identity(dataset):
        raise RunError(f"{run}: was trained on another scene or seed than that of {dataset.folder}")


def _split(targets: Targets, seed: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows to train on, and rows of a few pairs held back to watch for overfitting (not the held-out pairs of the
    evaluation)."""
    pairs = int(targets.pair.max()) + 1
    chosen = np.random.default_rng([seed, 3]).choice(pairs, max(1, round(_VALIDATION_SHARE * pairs)), replace=False)
    held_back = np.isin(targets.pair, chosen)
    return np.flatnonzero(~held_back), np.flatnonzero(held_back)


def _batches(
    targets: Targets, rows: npt.NDArray[np.int64], size: int, device: torch.device
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Listener, emitter, yaw and flat target of consecutive batches of the rows; a last, smaller one is included."""
    for start in range(0, len(rows), size):
        chosen = np.sort(rows[start : start + size])
        parts = (targets.listener, targets.emitter, targets.yaw, targets.flat)
        listener, emitter, yaw, flat = (torch.from_numpy(part[chosen]).to(device) for part in parts)
        yield listener, emitter, yaw, flat.float()


@torch.no_grad()
def _initialise(field: FactorisedField, targets: Targets, rows: npt.NDArray[np.int64], seed: int) -> None:
    """Normalisation, and a basis that starts from the principal components of the training spectrograms."""
    sample = np.sort(np.random.default_rng([seed, 4]).choice(rows, min(_SAMPLE_ROWS, len(rows)), replace=False))
    flat = torch.from_numpy(targets.flat[sample]).float()
    field.mean.copy_(flat.mean(dim=0))
    for name, part in field.heads.slices.items():
        field.spread[part] = _SPREADS[name]
    normalised = (flat.to(field.mean.device) - field.mean) / field.spread
    rank = field.basis.shape[0]
    _, singular, basis = torch.svd_lowrank(normalised, q=min(rank, len(sample)), niter=2)
    field.basis[: basis.shape[1]] = basis.T * (singular / len(sample) ** 0.5)[:, None]


def _loss(field: FactorisedField, prediction: Tensor, flat: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    residual = prediction - (flat - field.mean) / field.spread
    parts = {name: residual[:, part].square().mean() for name, part in field.heads.slices.items()}
    return torch.stack([_HEAD_WEIGHTS[name] * value for name, value in parts.items()]).sum(), parts


def _train_epoch(
    field: FactorisedField,
    optimiser: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
    targets: Targets,
    rows: npt.NDArray[np.int64],
    configuration: Configuration,
    epoch: int,
) -> float:
    field.train()
    order = np.random.default_rng([configuration.seed, 5, epoch]).permutation(rows)
    size = _batch_size(configuration, rows)
    order = order[: len(order) // size * size]
    total = 0.0
    for listener, emitter, yaw, flat in _batches(targets, order, size, field.mean.device):
        loss, _ = _loss(field, field(listener, emitter, yaw), flat)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(field.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        total += float(loss.detach())
    return total / (len(order) // size)


def _batch_size(configuration: Configuration, rows: npt.NDArray[np.int64]) -> int:
    """Small scenes have fewer rows than a batch."""
    return min(configuration.batch, len(rows))


@torch.no_grad()
def _validate(field: FactorisedField, targets: Targets, rows: npt.NDArray[np.int64], batch: int) -> dict[str, float]:
    field.eval()
    totals = dict.fromkeys(field.heads.slices, 0.0)
    for listener, emitter, yaw, flat in _batches(targets, rows, batch, field.mean.device):
        _, parts = _loss(field, field(listener, emitter, yaw), flat)
        for name, value in parts.items():
            totals[name] += float(value) * len(yaw) / len(rows)
    return totals


@torch.no_grad()
def _level_correction(field: FactorisedField, targets: Targets, rows: npt.NDArray[np.int64]) -> Tensor:
    """What to add to predicted log-magnitudes so that their power is right on average over the training set.

    A regression on log-magnitude predicts the mean of the log, 2.5 dB below the log of the mean power for noise.
    Residuals say by how much, output by output.
    """
    field.eval()
    power = torch.zeros_like(field.mean)
    sample = rows[:: max(1, len(rows) // _SAMPLE_ROWS)]
    for listener, emitter, yaw, flat in _batches(targets, sample, 256, field.mean.device):
        residual = flat - field.in_physical_units(field(listener, emitter, yaw))
        power += torch.exp(2 * residual).sum(dim=0) / len(sample)
    correction = torch.zeros_like(field.mean)
    for name in ("fine", "late"):
        part = field.heads.slices[name]
        correction[part] = 0.5 * torch.log(power[part])
    return correction


def _save(path: Path, state: dict[str, object]) -> None:
    """An interrupt in the middle of writing leaves the previous checkpoint whole."""
    partial = path.with_suffix(".partial")
    torch.save(state, partial)
    partial.replace(path)


def _log(path: Path, row: dict[str, float]) -> None:
    fresh = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if fresh:
            writer.writeheader()
        writer.writerow({name: f"{value:.6g}" for name, value in row.items()})
