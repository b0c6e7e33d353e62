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
from training.learning.energies import RAYLEIGH_DEFICIT, EnergyError
from training.learning.learner import Losses, Rows
from training.learning.lessons import DistillationTargets, lessons_of
from training.learning.naf import NafLearner
from training.learning.runs import Configuration, FactorisedRecipe, RecipeError, require_same_data, restore
from training.learning.schedule import one_cycle
from training.models.cells import Cells
from training.models.factorised import FactorisedField, FieldShape
from training.models.level_correction import LevelsInterpolated, level_correction
from training.models.site import Reach, Site
from training.models.stored_targets import Targets, load_targets
from training.models.targets import codec_of

# What a target differs by from the best possible prediction (ln magnitude of one noisy bin, of a pooled cell; unit
# phasors): errors are measured in these, so that every head's loss starts to matter at the same distance from its
# floor.
_SPREADS = {"fine": 0.64, "late": 0.25, "phasor": 1.0, "interaural": 1.0}
# Coherences are smooth in the poses, so errors of few hundredths are left; weighted alike they would be lost beside the
# levels'.
_HEAD_WEIGHTS = {"fine": 1.0, "late": 1.0, "phasor": 2.0, "interaural": 10.0}
_LEVEL_HEADS = ("fine", "late")
TARGETS = "targets"
"""Folder of targets in that of a dataset."""
_WEIGHT_DECAY = 1e-2
_SAMPLE_ROWS = 3000
# A measured response starts with the direct sound, whose phase can be learned; reflections have hardly one.
_KNOWN_FRAMES_OF_WHOLE_RESPONSES = 12


class FactorisedLearner:
    """Learns from targets that are computed once and kept beside the responses."""

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
        self._lessons: DistillationTargets | None = None

    def prepare(self, progress: Progress) -> None:
        if self.recipe.teacher is not None:
            self._lessons = self._taught(Path(self.recipe.teacher))
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
        """Normalisation, and a basis that starts from the principal components of the training spectrograms."""
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
        """Lessons are counted on from the last response."""
        if self._lessons is None:
            return rng.permutation(rows)
        measured = len(self.targets.yaw)
        return rng.permutation(np.concatenate([rows, measured + np.arange(len(self._lessons.yaw))]))

    def validation(self, rows: Rows) -> Rows:
        return rows

    def batch(self, rows: Rows, rng: np.random.Generator | None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        rows = np.sort(rows)
        measured = int(np.searchsorted(rows, len(self.targets.yaw)))
        parts = [_rows_of(self.targets, rows[:measured])]
        if self._lessons is not None:
            parts.append(_rows_of(self._lessons, rows[measured:] - len(self.targets.yaw)))
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
        squared = off * off  # whose gradient is quicker than that of a power
        losses = {}
        # Split, not sliced: the gradient of every slice would be as wide as the whole.
        for name, part in zip(field.heads.shapes, squared.split(field.heads.sizes, dim=1), strict=True):
            of_rows = part.mean(dim=1)
            # Lessons are of levels alone.
            counted = of_rows if name in _LEVEL_HEADS else of_rows * measured
            losses[name] = _HEAD_WEIGHTS[name] * counted.mean()
        if self.recipe.energy_weight:
            levels = field.heads.levels
            predicted = prediction[:, levels] * field.spread[levels] + field.mean[levels]
            error = self._energy_error.to(flat.device)(predicted, flat[:, levels])
            losses["energy"] = self.recipe.energy_weight * error
        return losses

    def _taught(self, run: Path) -> DistillationTargets:
        """Raises RunError if the folder holds no finished run on these data, and RecipeError if it is of another
        kind."""
        configuration = Configuration.read(run)
        if configuration.kind != "naf" or configuration.name in {"naf-time-domain", "naf-whole"}:
            problem = "a naf with spectrograms of what is learned here can teach"
            raise RecipeError(f"teacher: {run} holds {configuration.name}; {problem}")
        require_same_data(self.responses, run)
        teacher = NafLearner(self.responses, configuration)
        restore(teacher.field, run, configuration)
        return lessons_of(teacher, self.cells, self.recipe.lessons, configuration.seed)

    @torch.no_grad()
    def finish(self, rows: Rows) -> None:
        """Correct levels by what is heard of them too little, or too much, on average over the training set."""
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

        heard = LevelsInterpolated(self.cells, self.responses.channels).to(device)
        field.level_correction[:, levels] = level_correction(examples, heard, field.heads.areas)


def _rows_of(source: Targets | DistillationTargets, rows: Rows) -> tuple[npt.NDArray[np.floating], ...]:
    """Listener, emitter, yaw and flat target."""
    return source.listener[rows], source.emitter[rows], source.yaw[rows], source.flat[rows]
