"""The factorised field and its loss."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import Progress
from torch import Tensor

from training.data.responses import ResponseSet
from training.learning.basis import TARGETS, BasisLearner
from training.learning.distillation import DistillationTargets, distillation_targets
from training.learning.energies import RAYLEIGH_DEFICIT, EnergyError
from training.learning.learner import Losses, Rows
from training.learning.naf import NafLearner
from training.learning.runs import (
    Configuration,
    FactorisedRecipe,
    RecipeError,
    require_same_data,
    require_still_doors,
    restore,
)
from training.models.cells import Cells
from training.models.encoders import FieldShape
from training.models.factorised import FactorisedField
from training.models.level_correction import InterpolatedLevels
from training.models.site import Reach, Site
from training.models.stored_targets import Targets, load_targets
from training.models.targets import codec_of
from training.simulation.responses import SimulatedResponses

# Errors are measured in units of how far targets scatter about the best possible prediction: in ln magnitude for one
# noisy bin and for a pooled cell, and in unit phasors. The losses of all heads then have the same floor.
_SPREADS = {"fine": 0.64, "late": 0.25, "phasor": 1.0, "interaural": 1.0}
# Coherence is smooth in the poses, and its errors are a few hundredths; with equal weights they would not count beside
# the errors of levels.
_HEAD_WEIGHTS = {"fine": 1.0, "late": 1.0, "phasor": 2.0, "interaural": 10.0}
_LEVEL_HEADS = ("fine", "late")
# A measured response begins with the direct sound, whose phase can be learned, unlike that of reflections.
_KNOWN_FRAMES_OF_WHOLE_RESPONSES = 12


class FactorisedLearner(BasisLearner):
    """Learns what arrives at the ears of a head, or at a microphone."""

    def __init__(self, responses: ResponseSet, configuration: Configuration) -> None:
        shape, recipe = configuration.shape, configuration.recipe
        if not isinstance(shape, FieldShape) or not isinstance(recipe, FactorisedRecipe):
            raise TypeError(f"{configuration.kind} is no factorised field")
        if recipe.swap and responses.channels == 2:
            raise RecipeError(
                "swap: a head is no loudspeaker, so binaural responses differ with their ends exchanged; leave it off"
            )
        require_still_doors(responses, configuration.kind)
        self.responses = responses
        self.recipe = recipe
        is_simulated = isinstance(responses, SimulatedResponses)
        self._expected = recipe.expected and is_simulated
        known = 1 if is_simulated else _KNOWN_FRAMES_OF_WHOLE_RESPONSES
        codec = codec_of(responses)
        self.cells = Cells(codec, min(recipe.fine_frames, codec.frames - 1), min(known, recipe.fine_frames))
        self.site = Site.of(responses)
        field = FactorisedField(self.site.extent, self.cells, shape, responses.channels, reach=Reach.of(responses))
        decode = InterpolatedLevels(self.cells, responses.channels) if recipe.level_correction else None
        super().__init__(field, _SPREADS, _HEAD_WEIGHTS, decode)
        deficit = 0.0 if self._expected else RAYLEIGH_DEFICIT
        self._energy_error = EnergyError(self.cells, field.heads, deficit=deficit)
        self._distilled: DistillationTargets | None = None

    def prepare(self, progress: Progress) -> None:
        if self.recipe.teacher is not None:
            self._distilled = self._distill(Path(self.recipe.teacher))
        folder = self.responses.file.parent / TARGETS
        self._targets = load_targets(self.responses, self.cells, folder, progress, expected=self._expected)

    def epoch(self, rows: Rows, rng: np.random.Generator) -> Rows:
        """Return the rows of an epoch in random order; rows of distillation targets follow those of the responses."""
        if self._distilled is None:
            return rng.permutation(rows)
        measured = len(self.targets.yaw)
        return rng.permutation(np.concatenate([rows, measured + np.arange(len(self._distilled.yaw))]))

    def batch(self, rows: Rows, rng: np.random.Generator | None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        rows = np.sort(rows)
        measured = int(np.searchsorted(rows, len(self.targets.yaw)))
        parts = [_rows_of(self.targets, rows[:measured])]
        if self._distilled is not None:
            parts.append(_rows_of(self._distilled, rows[measured:] - len(self.targets.yaw)))
        listener, emitter, yaw, flat = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        if self.recipe.swap and rng is not None:
            swapped = (rng.random(len(rows)) < 0.5)[:, None]
            listener, emitter = np.where(swapped, emitter, listener), np.where(swapped, listener, emitter)
        poses = (listener, emitter, yaw, self.site.paths(listener, emitter))
        return tuple(map(torch.from_numpy, poses)), (torch.from_numpy(flat), torch.arange(len(rows)) < measured)

    def losses(self, prediction: Tensor, targets: tuple[Tensor, ...]) -> Losses:
        flat, measured = targets[0].float(), targets[1]
        # Distillation targets have valid levels only.
        others = [name for name in self.field.heads.shapes if name not in _LEVEL_HEADS]
        errors = self._head_errors(prediction, flat, dict.fromkeys(others, measured))
        if self.recipe.energy_weight:
            error = self._energy_error.to(flat.device)(self._levels_of(prediction), flat[:, self.field.heads.levels])
            errors["energy"] = self.recipe.energy_weight * error
        return {name: of_rows.mean() for name, of_rows in errors.items()}

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


def _rows_of(source: Targets | DistillationTargets, rows: Rows) -> tuple[npt.NDArray[np.floating], ...]:
    """Return listener, emitter, yaw and flat target of these rows."""
    return source.listener[rows], source.emitter[rows], source.yaw[rows], source.flat[rows]
