"""Whole simulated responses: the stored reflected sound of a pair, and its direct sound.

The direct sound is not stored. It follows from geometry alone, by the synthesis that the reflections went through.
"""

from dataclasses import dataclass
from functools import cached_property

import h5py
import numpy as np
import numpy.typing as npt

from server.whole_field import kemar
from training.dataset import Dataset
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis

_Responses = npt.NDArray[np.float32]


@dataclass(frozen=True)
class DirectSound:
    """The simulated direct sound of every pair of probes of a dataset."""

    dataset: Dataset

    @cached_property
    def _synthesis(self) -> BinauralSynthesis:
        dataset = self.dataset
        directions = sphere_directions(dataset.scene.simulation.arrival_directions)
        return BinauralSynthesis(kemar(dataset.sample_rate), directions, dataset.yaws, dataset.samples)

    @cached_property
    def _visible(self) -> npt.NDArray[np.bool_]:
        """(emitter, listener)"""
        return self.dataset.plan.is_visible(self.dataset.probes[:, None], self.dataset.probes[None])

    def response(self, emitter: int, listener: int) -> _Responses:
        """(yaw, ear, sample); silent where a wall stands between."""
        if not self._visible[emitter, listener]:
            return np.zeros((len(self.dataset.yaws), 2, self.dataset.samples), dtype=np.float32)
        ends = self.dataset.probes[emitter], self.dataset.probes[listener]
        return self._synthesis.direct(*ends, self.dataset.scene.air)


class References:
    """Whole responses of an open dataset by flat pair index, emitter-major; `take` is "reflected" or "repeats"."""

    def __init__(self, dataset: Dataset, file: h5py.File, take: str = "reflected") -> None:
        self._reflected: h5py.Dataset = file[take]
        self._direct = DirectSound(dataset)
        self._probes = len(dataset.probes)

    def __getitem__(self, pair: int) -> _Responses:
        """(yaw, ear, sample)"""
        emitter, listener = divmod(int(pair), self._probes)
        reflected = np.asarray(self._reflected[emitter, listener], dtype=np.float32)
        return reflected + self._direct.response(emitter, listener)
