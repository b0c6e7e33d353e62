"""The directional field and its loss."""

from collections.abc import Callable, Sequence, Set

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import Progress
from torch import Tensor, nn

from server.field.directional_graph import DIRECTIONS, LOG_MAGNITUDE
from training.data.responses import ResponseSet
from training.learning.basis import TARGETS, BasisLearner
from training.learning.energies import BandEnergyError
from training.learning.learner import Losses, Rows
from training.learning.pairs import split
from training.learning.runs import Configuration, DirectionalRecipe, RecipeError
from training.models.cells import Cells
from training.models.directional import DirectionalField
from training.models.encoders import FieldShape
from training.models.level_correction import InterpolatedBands
from training.models.site import Reach, Site
from training.models.stored_targets import load_directional_targets
from training.models.targets import codec_of
from training.simulation.responses import SimulatedResponses

# In nepers, and in shares of the power: about what no field can predict from the places alone.
_SPREADS = {LOG_MAGNITUDE: 0.35, DIRECTIONS: 0.5}
_EXCHANGED_SHARE = 0.5
_FIT_STEPS, _FIT_RATE = 400, 0.05
_FIT_OUTLIER = 0.5
"""Nepers beyond which a level counts in proportion, and not by its square."""
_LEAST_ERROR = 0.05
"""What is added to the errors of pairs, so that none of them counts for all others."""
_HEAD_WEIGHTS = {LOG_MAGNITUDE: 1.0, DIRECTIONS: 1.0}


class DirectionalLearner(BasisLearner):
    """Learns where sound arrives from, one example for each pair: the orientations of a head do not matter."""

    def __init__(self, responses: ResponseSet, configuration: Configuration) -> None:
        shape, recipe = configuration.shape, configuration.recipe
        if not isinstance(shape, FieldShape) or not isinstance(recipe, DirectionalRecipe):
            raise TypeError(f"{configuration.kind} is no directional field")
        if not isinstance(responses, SimulatedResponses):
            raise RecipeError(
                "field: measured responses do not tell where sound arrives from; train factorised in place of "
                "directional"
            )
        self.responses = responses
        self.recipe = recipe
        codec = codec_of(responses)
        self.cells = Cells(codec, min(recipe.fine_frames, codec.frames - 1), known_frames=0)
        self.site = Site.of(responses)
        extent = self.site.extent
        dropout = recipe.dropout if extent.doors else 0.0
        try:
            field = DirectionalField(
                extent, self.cells, shape, recipe.order, reach=Reach.of(responses), dropout=dropout
            )
        except ValueError as exc:
            raise RecipeError(str(exc)) from exc
        super().__init__(field, _SPREADS, _HEAD_WEIGHTS, InterpolatedBands(self.cells))
        self._energy_error = BandEnergyError(self.cells)
        trainable = np.flatnonzero(~responses.held_out)
        # Rows count responses, targets count pairs.
        _, first, self._pair = np.unique(responses.pair[trainable], return_index=True, return_inverse=True)
        used, _ = split(responses, share=configuration.share, seed=configuration.seed)
        ends = [responses.ends(row) for row in trainable[first]]
        self._openness = responses.openness[trainable[first]].astype(np.float32)
        pairs = np.arange(len(ends))
        self._partner = _exchanged(ends, set(self._pair[used].tolist()), self._openness) if recipe.reciprocal else pairs
        self._one_way = (recipe.reciprocal and extent.doors > 0) & (self._partner == pairs)

    def prepare(self, progress: Progress) -> None:
        folder = self.responses.file.parent / TARGETS
        self._targets = load_directional_targets(self.responses, self.cells, folder, progress)
        power = np.exp(2 * self._targets.flat[:, self.field.heads.levels].astype(np.float32))
        self._levels = 0.5 * np.log((power + power[self._partner]) / 2)

    def epoch(self, rows: Rows, rng: np.random.Generator) -> Rows:
        """Return one row of each pair in random order."""
        return rng.permutation(self._one_of_each_pair(rows))

    def validation(self, rows: Rows) -> Rows:
        return self._one_of_each_pair(rows)

    def batch(self, rows: Rows, rng: np.random.Generator | None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        pairs = self._pair[rows]
        listener, emitter = self.targets.listener[pairs], self.targets.emitter[pairs]
        if rng is not None and self.recipe.noise_m:
            listener, emitter = (
                end + rng.normal(0, self.recipe.noise_m, end.shape).astype(np.float32) for end in (listener, emitter)
            )
        exchanged = np.zeros(len(pairs), dtype=bool)
        if rng is not None:
            exchanged = self._one_way[pairs] & (rng.random(len(pairs)) < _EXCHANGED_SHARE)
            listener, emitter = (
                np.where(exchanged[:, None], there, here) for here, there in ((listener, emitter), (emitter, listener))
            )
        openness = self._openness[pairs]
        paths = self.site.paths(listener, emitter, openness)
        if rng is not None:
            openness = _blurred(openness, self.recipe.openness_noise, rng)
        told = (openness,) if openness.shape[1] else ()
        poses = (listener, emitter, paths, *told)
        knows_directions = torch.from_numpy((~exchanged).astype(np.float32))
        return tuple(map(torch.from_numpy, poses)), (self._flat(rows), knows_directions)

    def losses(self, prediction: Tensor, targets: tuple[Tensor, ...]) -> Losses:
        """Means over pairs, which count alike in validation, and as `_shares` says in training."""
        flat, knows_directions = targets
        errors = self._head_errors(prediction, flat, {DIRECTIONS: knows_directions})
        error = self._energy_error.to(flat.device)(self._levels_of(prediction), flat[:, self.field.heads.levels])
        errors["energy"] = self.recipe.energy_weight * error
        whole = torch.stack(list(errors.values())).sum(dim=0)
        shares = _shares(whole.detach() if self.field.training else torch.ones_like(whole))
        return {name: shares @ of_pairs for name, of_pairs in errors.items()}

    def _losses_between(self, rows: Rows) -> Tensor:
        """What these pairs say of it, whichever rooms are louder or quieter with all doors open."""
        if not self.field.encoder.doors:
            return super()._losses_between(rows)
        encoder = self.field.encoder
        (listener, emitter, _, openness), (flat, _) = self.batch(rows, None)
        rooms = encoder.rooms(listener, emitter)
        power = torch.exp(2 * flat[:, self.field.heads.levels]) * self.field.heads.areas
        levels = 0.5 * torch.log(power.unflatten(1, (len(self.field.bands), -1)).sum(dim=-1))
        _, couple = torch.unique(rooms.sort(dim=1).values, dim=0, return_inverse=True)
        fit_losses(lambda: encoder.losses(rooms, openness), list(encoder.losses_learned), levels, couple)
        return encoder.losses(rooms, openness)

    def _flat(self, rows: Rows) -> Tensor:
        """(row, heads.size) targets of the recipe's order, which are the beginning of those that are stored."""
        pairs, levels, size = self._pair[rows], self.field.heads.levels, self.field.heads.size
        shares = self.targets.flat[pairs, levels.stop : size].astype(np.float32)
        return torch.from_numpy(np.concatenate([self._levels[pairs], shares], axis=1))

    def _one_of_each_pair(self, rows: Rows) -> Rows:
        _, first = np.unique(self._pair[rows], return_index=True)
        return rows[np.sort(first)]


def _shares(errors: Tensor) -> Tensor:
    """(B,) how much each pair counts, whose `errors` (B,) are these; 1 in all.

    Chance decides more about pairs that few rays join than about those in sight, which would then hardly count. So each
    pair is taken to have a variance of its own, which its error tells: the gradient is that of the mean logarithm of
    errors, and so of the likelihood with the most likely variances."""
    weights = 1 / (errors + _LEAST_ERROR)
    return weights / weights.sum()


@torch.enable_grad()
def fit_losses(
    losses: Callable[[], Tensor], learned: Sequence[nn.Parameter], levels: Tensor, couple: npt.ArrayLike
) -> None:
    """Adjust what is `learned`, so that `losses` (pair, band) follow `levels` but for one constant of each `couple`
    (pair,) and band. Far outliers count little (Huber's loss)."""
    members = nn.functional.one_hot(torch.as_tensor(couple)).float()
    shares = members / members.sum(dim=0)
    optimiser = torch.optim.Adam(learned, _FIT_RATE)
    for _ in range(_FIT_STEPS):
        off = losses() - levels
        off = off - members @ (shares.T @ off)
        optimiser.zero_grad()
        nn.functional.huber_loss(off, torch.zeros_like(off), delta=_FIT_OUTLIER).backward()
        optimiser.step()


def _exchanged(
    ends: Sequence[tuple[int, int]], used: Set[int], openness: npt.NDArray[np.float32]
) -> npt.NDArray[np.int64]:
    """(pair,) the number of the pair with exchanged ends, where both are used with doors equally open, else that of the
    pair itself."""
    numbers = {pair: number for number, pair in enumerate(ends) if number in used}
    partners = [numbers.get((listener, emitter), number) for number, (emitter, listener) in enumerate(ends)]
    found = np.array([partner if number in used else number for number, partner in enumerate(partners)])
    return np.where((openness == openness[found]).all(axis=1), found, np.arange(len(found)))


def _blurred(openness: npt.NDArray[np.float32], deviation: float, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """`openness` with noise where doors are ajar: of this standard deviation where they are half open, and in
    proportion to how far they are from shut and from open."""
    ajar = rng.normal(openness, 4 * deviation * openness * (1 - openness))
    return np.where((openness > 0) & (openness < 1), ajar.clip(0, 1), openness).astype(np.float32)
