"""The responses of a simulated dataset at its own yaws, drawn from its energies when they are read."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from training.data.dataset import Dataset
from training.data.responses import ImportedDataset
from training.simulation.references import References

_Responses = npt.NDArray[np.float32]


class SimulatedResponses:
    """The rows of a simulated dataset, ordered by emitter, listener and yaw. They are late reverberation only, or with
    `whole` also direct sound and first reflections, like measured ones."""

    channels = 2

    def __init__(self, dataset: Dataset, *, whole: bool = False) -> None:
        self.dataset, self.whole = dataset, whole
        self._pairs = np.argwhere(dataset.trained | dataset.held_out)
        yaws = len(dataset.yaws)
        emitter, listener = np.repeat(self._pairs, yaws, axis=0).T
        self.openness = dataset.states.openness[emitter]
        self.emitter, self.listener = dataset.probes[emitter], dataset.probes[listener]
        self.yaw = np.tile(dataset.yaws, len(self._pairs))
        self.pair = np.repeat(np.arange(len(self._pairs)), yaws)
        self.held_out = dataset.held_out[emitter, listener]
        self.onset_s = dataset.onset_s[emitter, listener]
        self._of_yaws: dict[tuple[int, ...], References] = {}

    @property
    def sample_rate(self) -> int:
        return self.dataset.sample_rate

    @property
    def samples(self) -> int:
        return self.dataset.samples

    @property
    def file(self) -> Path:
        return self.dataset.folder / "pairs.h5"

    def ends(self, row: int) -> tuple[int, int]:
        """Probe numbers of the emitter and the listener of a row."""
        emitter, listener = self._pairs[self.pair[row]]
        return int(emitter), int(listener)

    def read(self, rows: npt.ArrayLike) -> _Responses:
        """(n, ear, sample)"""
        rows = np.asarray(rows, dtype=np.int64)
        responses = np.empty((len(rows), self.channels, self.samples), np.float32)
        for pair in np.unique(self.pair[rows]):
            here = np.flatnonzero(self.pair[rows] == pair)
            yaws, which = np.unique(rows[here] % len(self.dataset.yaws), return_inverse=True)
            references = self._at(tuple(yaws.tolist()))
            heard = references.complete if self.whole else references.reflected
            responses[here] = heard(*self.ends(rows[here[0]]))[which]
        return responses

    def _at(self, yaws: tuple[int, ...]) -> References:
        """The references at the yaws of these numbers; the spectra of their heads are computed once."""
        if yaws not in self._of_yaws:
            self._of_yaws[yaws] = References(self.dataset, heads=self.dataset.yaws[list(yaws)])
        return self._of_yaws[yaws]


def open_responses(folder: Path) -> SimulatedResponses | ImportedDataset:
    """Opens a simulated dataset or a folder of imported responses.

    Raises DatasetError or ResponsesError if the folder holds neither, or a damaged one.
    """
    if (folder / "pairs.h5").exists():
        return SimulatedResponses(Dataset.open(folder))
    return ImportedDataset.open(folder)
