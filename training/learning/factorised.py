"""The factorised field and its loss."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import Progress
from torch import Tensor

from training.data.responses import ResponseSet, SimulatedResponses
from training.learning.distillation import DistillationTargets, distillation_targets
from training.learning.energies import RAYLEIGH_DEFICIT, EnergyError
from training.learning.learner import Losses, Rows
from training.learning.naf import NafLearner
from training.learning.runs import Configuration, FactorisedRecipe, RecipeError, require_same_data, restore
from training.learning.schedule import one_cycle
from training.models.cells import Cells
from training.models.factorised import FactorisedField, FieldShape
from training.models.level_correction import InterpolatedLevels, level_correction
from training.models.site import Reach, Site
from training.models.stored_targets import Targets, load_targets
from training.models.targets import codec_of

# Errors are measured in units of how far targets scatter about the best possible prediction: in ln magnitude for one
# noisy bin and for a pooled cell, and in unit phasors. The losses of all heads then have the same floor.
_SPREADS = {"fine": 0.64, "late": 0.25, "phasor": 1.0, "interaural": 1.0}
# Coherence is smooth in the poses, and its errors are a few hundredths; with equal weights they would not count beside
# the errors of levels.
_HEAD_WEIGHTS = {"fine": 1.0, "late": 1.0, "phasor": 2.0, "interaural": 10.0}
_LEVEL_HEADS = ("fine", "late")
TARGETS = "targets"
"""The folder of targets, inside that of the dataset."""
_WEIGHT_DECAY = 1e-2
_SAMPLE_ROWS = 3000
# A measured response begins with the direct sound, whose phase can be learned, unlike that of reflections.
_KNOWN_FRAMES_OF_WHOLE_RESPONSES = 12


class FactorisedLearner:
    """Learns from targets that are computed once and stored beside the responses."""

    def __init__(self, responses: ResponseSet, configuration: Configuration) -> None:
        shape, recipe = configuration.shape, configuration.recipe
        if not isinstance(shape, FieldShape) or not isinstance(recipe, FactorisedRecipe):
            raise TypeError(f"{configuration.kind} is no factorised field")
        if recipe.swap and responses.channels == 2:
            raise RecipeError(
                "swap: a head is no loudspeaker, so binaural responses differ with their ends exchanged; leave it off"
            )
        self.responses = responses
        self.recipe = recipe
        is_simulated = isinstance(responses, SimulatedResponses)
        self._expected = recipe.expected and is_simulated
        known = 1 if is_simulated else _KNOWN_FRAMES_OF_WHOLE_RESPONSES
        codec = codec_of(responses)
        self.cells = Cells(codec, min(recipe.fine_frames, codec.frames - 1), min(known, recipe.fine_frames))
        self.site = Site.of(responses)
        self.field = FactorisedField(self.site.plan, self.cells, shape, responses.channels, reach=Reach.of(responses))
        deficit = 0.0 if self._expected else RAYLEIGH_DEFICIT
        self._energy_error = EnergyError(self.cells, self.field.heads, deficit=deficit)
        self._targets: Targets | None = None
        self._distilled: DistillationTargets | None = None

    def prepare(self, progress: Progress) -> None:
        if self.recipe.teacher is not None:
            self._distilled = self._distill(Path(self.recipe.teacher))
        folder = self.responses.file.parent / TARGETS
        self._targets = load_targets(self.responses, self.cells, folder, progress, expected=self._expected)

    @property
    def prepared_s(self) -> float:
        return self.targets.seconds

    @property
    def targets(self) -> Targets:
        if self._targets is None:
            raise RuntimeError("prepare comes first")
        return self._targets

    @torch.no_grad()
    def initialise(self, rows: Rows, seed: int) -> None:
        """Set the normalisation, and a basis that begins with the principal components of the training
        spectrograms."""
        field = self.field
        sample = np.sort(np.random.default_rng([seed, 4]).choice(rows, min(_SAMPLE_ROWS, len(rows)), replace=False))
        flat = torch.from_numpy(self.targets.flat[sample]).float()
        field.mean.copy_(flat.mean(dim=0))
        for name, part in field.heads.slices.items():
            field.spread[part] = _SPREADS[name]
        normalised = (flat.to(field.mean.device) - field.mean) / field.spread
        rank = field.basis.shape[0]
        _, singular, basis = torch.svd_lowrank(normalised, q=min(rank, *normalised.shape), niter=2)
        field.basis[: basis.shape[1]] = basis.T * (singular / len(sample) ** 0.5)[:, None]

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.field.parameters()), "weight_decay": _WEIGHT_DECAY}]

    def momentum_and_rate(self, fraction: float) -> tuple[float, float]:
        return one_cycle(fraction)

    def epoch(self, rows: Rows, rng: np.random.Generator) -> Rows:
        """Return the rows of an epoch in random order; rows of distillation targets follow those of the responses."""
        if self._distilled is None:
            return rng.permutation(rows)
        measured = len(self.targets.yaw)
        return rng.permutation(np.concatenate([rows, measured + np.arange(len(self._distilled.yaw))]))

    def validation(self, rows: Rows) -> Rows:
        return rows

    def batch(self, rows: Rows, rng: np.random.Generator | None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        rows = np.sort(rows)
        measured = int(np.searchsorted(rows, len(self.targets.yaw)))
        parts = [_rows_of(self.targets, rows[:measured])]
        if self._distilled is not None:
            parts.append(_rows_of(self._distilled, rows[measured:] - len(self.targets.yaw)))
        listener, emitter, yaw, flat = (
            torch.from_numpy(np.concatenate(columns)) for columns in zip(*parts, strict=True)
        )
        if self.recipe.swap and rng is not None:
            swapped = torch.from_numpy(rng.random(len(rows)) < 0.5)[:, None]
            listener, emitter = torch.where(swapped, emitter, listener), torch.where(swapped, listener, emitter)
        return (listener, emitter, yaw), (flat, torch.arange(len(rows)) < measured)

    def losses(self, prediction: Tensor, targets: tuple[Tensor, ...]) -> Losses:
        field, flat, measured = self.field, targets[0].float(), targets[1]
        off = prediction - (flat - field.mean) / field.spread
        squared = off * off  # its gradient is faster than that of a power
        losses = {}
        # Split in place of slicing, because the gradient of each slice would be as wide as the whole.
        for name, part in zip(field.heads.shapes, squared.split(field.heads.sizes, dim=1), strict=True):
            of_rows = part.mean(dim=1)
            # Distillation targets have valid levels only.
            counted = of_rows if name in _LEVEL_HEADS else of_rows * measured
            losses[name] = _HEAD_WEIGHTS[name] * counted.mean()
        if self.recipe.energy_weight:
            levels = field.heads.levels
            predicted = prediction[:, levels] * field.spread[levels] + field.mean[levels]
            error = self._energy_error.to(flat.device)(predicted, flat[:, levels])
            losses["energy"] = self.recipe.energy_weight * error
        return losses

    def _distill(self, run: Path) -> DistillationTargets:
        """Return the distillation targets of a finished `naf` run. Raises RunError if the folder holds no finished run
        on these data, and RecipeError if it is a run of another kind."""
        configuration = Configuration.read(run)
        if configuration.kind != "naf" or configuration.name in {"naf-time-domain", "naf-whole"}:
            problem = "only a naf that predicts spectrograms of late reverberation can teach"
            raise RecipeError(f"teacher: {run} holds {configuration.name}; {problem}")
        require_same_data(self.responses, run)
        teacher = NafLearner(self.responses, configuration)
        restore(teacher.field, run, configuration)
        return distillation_targets(teacher, self.cells, self.recipe.distilled_poses, configuration.seed)

    @torch.no_grad()
    def finish(self, rows: Rows) -> None:
        """Correct predicted levels by their mean deficit over the training set."""
        if not self.recipe.level_correction:
            return
        field, levels = self.field, self.field.heads.levels
        device = field.mean.device
        sample = rows[:: max(1, len(rows) // _SAMPLE_ROWS)]

        def examples() -> Iterator[tuple[Tensor, Tensor, Tensor]]:
            for start in range(0, len(sample), 256):
                poses, (flat, _) = self.batch(sample[start : start + 256], None)
                features = field.encoder(*(pose.to(device) for pose in poses))
                predicted = field.in_physical_units(field.coefficients_of(features) @ field.basis)
                yield flat[:, levels].to(device).float(), predicted[:, levels], field.encoder.sight(features)

        decode = InterpolatedLevels(self.cells, self.responses.channels).to(device)
        field.level_correction[:, levels] = level_correction(examples, decode, field.heads.areas)


def _rows_of(source: Targets | DistillationTargets, rows: Rows) -> tuple[npt.NDArray[np.floating], ...]:
    """Return listener, emitter, yaw and flat target of these rows."""
    return source.listener[rows], source.emitter[rows], source.yaw[rows], source.flat[rows]
