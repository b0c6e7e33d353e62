"""The paper's network and its loss. Each step trains on random points of a few whole responses."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import Progress
from scipy.ndimage import uniform_filter1d
from torch import Tensor

from training.data.responses import ResponseSet
from training.learning.basis import TARGETS
from training.learning.held import HeldTargets
from training.learning.learner import Losses, Rows
from training.learning.runs import Configuration, NafRecipe, RecipeError, require_still_doors
from training.learning.schedule import decay_to_a_tenth
from training.models.naf import Naf, NafShape
from training.models.site import Site
from training.models.stored_targets import Targets, load_aligned, load_expected_points
from training.models.targets import align, codec_of, delay_samples
from training.simulation.responses import SimulatedResponses

N_FFT = 512
_GRID_DECAY = 1e-2
_SIGMAS = 3.0
_LEAST_SIGMA = 0.1
_STATISTICS_ROWS = 600
_VALIDATION_ROWS = 24
_ENVELOPE_SAMPLES = 65


class NafLearner:
    """Computes targets as they are needed, from responses that are drawn once, or measured. That takes milliseconds; a
    step takes seconds. A step of a GPU takes milliseconds, too, so it computes them itself of what it holds."""

    def __init__(self, responses: ResponseSet, configuration: Configuration) -> None:
        shape, recipe = configuration.shape, configuration.recipe
        if not isinstance(shape, NafShape) or not isinstance(recipe, NafRecipe):
            raise TypeError(f"{configuration.kind} is no naf")
        if recipe.expected and (
            recipe.whole or shape.domain == "time" or not isinstance(responses, SimulatedResponses)
        ):
            raise RecipeError("field: only the spectrograms of simulated late reverberation have expected values")
        require_still_doors(responses, configuration.kind)
        self.responses = _whole(responses) if recipe.whole else responses
        self.recipe = recipe
        self.codec = codec_of(responses, N_FFT)
        self.site = Site.of(responses)
        sizes = (self.codec.bins, self.codec.frames) if shape.domain == "spectrogram" else (responses.samples,)
        self.field = Naf(self.site, sizes, responses.channels, shape)
        self._trainable = np.flatnonzero(~responses.held_out)
        self._drawn: Targets | None = None
        self._expected: Targets | None = None
        self._held: HeldTargets | None = None

    def prepare(self, progress: Progress) -> None:
        """Draw the responses of a simulation, or compute what is expected of them; measured ones are read as they are
        needed."""
        if self.recipe.expected:
            folder = self.responses.file.parent / TARGETS
            self._expected = load_expected_points(self.responses, self.codec, folder, progress)
        elif isinstance(self.responses, SimulatedResponses):
            self._drawn = load_aligned(self.responses, self.responses.file.parent / TARGETS, progress)

    def to(self, device: torch.device) -> None:
        self.field.to(device)
        targets = self._expected or self._drawn
        if targets is not None and HeldTargets.fit(targets.flat, device):
            self.hold(device)

    def hold(self, device: torch.device) -> None:
        """Keep the targets on the device, for batches that are made there; after `prepare`."""
        targets = self._expected or self._drawn
        if targets is None:
            raise RuntimeError("measured responses are read as they are needed")
        field, encoded = self.field, self._expected is not None
        self._held = HeldTargets(
            targets.flat, self.codec, field.channels, field.axes, field.shape.outputs, encoded=encoded, device=device
        )

    @property
    def prepared_s(self) -> float:
        targets = self._expected or self._drawn
        return 0.0 if targets is None else targets.seconds

    @torch.no_grad()
    def initialise(self, rows: Rows, seed: int) -> None:
        """Set mean and spread (three standard deviations) of every point over responses and ears, and the mean
        interaural coherence."""
        field = self.field
        sample = np.random.default_rng([seed, 4]).permutation(rows)[:_STATISTICS_ROWS]
        count, total, squares = 0, np.zeros(()), np.zeros(())
        cross, power = np.zeros(field.axes, complex), np.zeros((2, *field.axes))
        for row in self._trainable[np.sort(sample)]:
            values = self._values_of(row)
            count += len(values)
            total, squares = total + values.sum(axis=0), squares + (values**2).sum(axis=0)
            if hasattr(field, "coherence"):
                spectrogram = self.codec.transform(self._aligned(row))
                cross += spectrogram[0] * np.conj(spectrogram[1])
                power += np.abs(spectrogram) ** 2
        mean = total / count
        # guard: rounding leaves no variance below zero
        sigma = np.sqrt(np.maximum(squares / count - mean**2, 0))
        if field.shape.domain == "time":
            # A waveform has zero mean, and its level is a smooth function of time.
            mean, envelope = 0 * mean, np.sqrt(uniform_filter1d(squares / count, _ENVELOPE_SAMPLES, axis=0))
            sigma = np.maximum(envelope, 1e-4 * envelope.max())
        else:
            # Otherwise bins that hardly vary (silence before the onset) would make rounding errors large targets.
            # guard: a spread of zero is not divided by
            sigma = np.maximum(sigma, _LEAST_SIGMA)
        field.mean.copy_(torch.from_numpy(mean))
        field.spread.copy_(torch.from_numpy(_SIGMAS * sigma))
        if hasattr(field, "coherence"):
            # guard: ears in silence have no mean coherence
            coherence = cross / np.maximum(np.sqrt(power[0] * power[1]), 1e-20)
            field.coherence.copy_(torch.from_numpy(np.stack([coherence.real, coherence.imag])))

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return groups of parameters; only the features of the grids have weight decay."""
        grids = [grid.features for grid in self.field.grids]
        others = [part for part in self.field.parameters() if not any(part is held for held in grids)]
        groups: list[dict[str, Any]] = [{"params": others, "weight_decay": 0.0}]
        return groups + ([{"params": grids, "weight_decay": _GRID_DECAY}] if grids else [])

    def momentum_and_rate(self, fraction: float) -> tuple[float, float]:
        return decay_to_a_tenth(fraction)

    def epoch(self, rows: Rows, rng: np.random.Generator) -> Rows:
        """Return every pair once, each at a random orientation."""
        shuffled = rng.permutation(rows)
        _, first = np.unique(self.responses.pair[self._trainable[shuffled]], return_index=True)
        return shuffled[np.sort(first)]

    def validation(self, rows: Rows) -> Rows:
        return rows[:: max(1, len(rows) // _VALIDATION_ROWS)][:_VALIDATION_ROWS]

    def batch(self, rows: Rows, rng: np.random.Generator | None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        validating = rng is None
        rng = np.random.default_rng(0) if rng is None else rng
        field, recipe, chosen = self.field, self.recipe, self._trainable[rows]
        drawn = np.empty((len(field.axes), len(rows), recipe.points), dtype=np.int64)
        for number, row in enumerate(chosen):
            *across, frames = field.axes
            padded = validating or rng.random() < recipe.padding
            reach = frames if padded else min(frames, self._recorded_length(row))
            drawn[:, number] = [rng.integers(0, size, recipe.points) for size in (*across, reach)]
        indices = torch.from_numpy(drawn)
        poses = [part[chosen] for part in (self.responses.listener, self.responses.emitter, self.responses.yaw)]
        if not validating:
            for position in poses[:2]:
                position += rng.normal(0, recipe.noise_m, position.shape)
        if self._held is None:
            values = self._values_at(chosen, drawn)
        else:
            indices = indices.to(self._held.device)
            values = self._held.at(rows, indices)
        inputs = *(torch.from_numpy(pose.astype(np.float32)) for pose in poses), *indices
        return inputs, (values, indices)

    def losses(self, prediction: Tensor, targets: tuple[Tensor, ...]) -> Losses:
        values, indices = targets
        at = tuple(indices)
        mean, spread = self.field.mean[at][:, None], self.field.spread[at][:, None]
        squared = (prediction - (values - mean) / spread).square()
        if self.field.shape.domain == "time":
            return {"waveform": squared.mean()}
        return {"magnitude": squared[..., 0].mean(), "phase": self.recipe.phase_weight * squared[..., 1].mean()}

    def finish(self, rows: Rows) -> None:
        """Do nothing."""

    def _aligned(self, row: int) -> npt.NDArray[np.float64]:
        """Return the response of a row (ear, sample), shifted so that its sound arrives at the beginning."""
        if self._drawn is None:
            return align(self.responses.read([row])[0], delay_samples(self.responses, row))
        flat = self._drawn.flat[np.searchsorted(self._trainable, row)]
        return np.asarray(flat.reshape(self.responses.channels, -1), np.float64)

    def _values_at(self, chosen: Rows, indices: npt.NDArray[np.int64]) -> Tensor:
        """(B, ear, N, outputs) values of responses (B,) at points (axis, B, N)."""
        field = self.field
        values = np.empty((len(chosen), field.channels, indices.shape[-1], field.shape.outputs), dtype=np.float32)
        for number, row in enumerate(chosen):
            of_ears: Any = self._values_of(row)
            values[number] = of_ears[:, *indices[:, number]]
        return torch.from_numpy(values)

    def _values_of(self, row: int) -> npt.NDArray[np.floating]:
        """Return the values that the network learns of a row: (ear, *axes, outputs)."""
        if self._expected is None:
            return self._values(self._aligned(row))
        flat = self._expected.flat[np.searchsorted(self._trainable, row)]
        return np.asarray(flat.reshape(self.responses.channels, *self.field.axes, -1), np.float64)

    def _values(self, aligned: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the values that the network learns, for an aligned response: (ear, *axes, outputs)."""
        if self.field.shape.domain == "time":
            return aligned[..., None]
        return np.stack(self.codec.encode(aligned), axis=-1)

    def _recorded_length(self, row: int) -> int:
        """The number of frames (or samples) of an aligned response until the end of the recording; silence follows."""
        left = self.responses.samples - delay_samples(self.responses, row)
        if self.field.shape.domain == "time":
            return max(1, int(left))
        # guard: a response that ends before sound arrives has a frame
        return max(1, int(np.sum(self.codec.frame_times_s * self.responses.sample_rate < left)))


def _whole(responses: ResponseSet) -> SimulatedResponses:
    """The responses with direct sound and first reflections. Raises RecipeError for measured responses, which have them
    already."""
    if not isinstance(responses, SimulatedResponses):
        raise RecipeError("field: measured responses are whole as they are; train naf in place of naf-whole")
    return SimulatedResponses(responses.dataset, whole=True)
