"""A room as it might have been measured, of which all is known in closed form."""

from pathlib import Path

import numpy as np

from training.baselines.baselines import TrainingPairs
from training.data.dataset import SPEED_OF_SOUND
from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset, Measurement

RATE = 16_000
SAMPLES = 2400


class Room:
    """Microphones every 5 cm with gains of their own, loudspeakers that beam: smooth in place, and a diffuse tail that
    nobody can foresee."""

    def __init__(self, *, tail=0.02):
        rng = np.random.default_rng(4)
        self.listeners = np.column_stack([np.zeros(20), 0.05 * np.arange(20), np.zeros(20)])
        self.emitters = np.array([[0.6, 0.1, 0.0], [0.9, 0.5, 0.0], [0.7, 0.9, 0.0]])
        self.emitter, self.listener = np.divmod(np.arange(60), 20)
        ends = self.emitters[self.emitter], self.listeners[self.listener]
        offset = ends[1] - ends[0]
        distance = np.linalg.norm(offset, axis=-1)
        self.delays_s = distance / SPEED_OF_SOUND
        gain = rng.uniform(0.8, 1.25, 20)[self.listener]
        beam = 0.6 + 0.4 * np.cos(3 * np.arctan2(offset[:, 1], offset[:, 0]))
        time = np.arange(SAMPLES) / RATE - self.delays_s[:, None]
        direct = np.sinc(time * RATE) * (beam / distance)[:, None]
        diffuse = tail * rng.standard_normal((60, SAMPLES)) * np.exp(-6.9 * np.maximum(time, 0) / 0.2) * (time > 0)
        self.responses = ((direct + diffuse) * gain[:, None]).astype(np.float32)[:, None, None]  # pair, yaw, channel
        training = np.random.default_rng(5).random(60) > 0.3
        self.held_out = np.flatnonzero(~training)
        self.pairs = TrainingPairs(self.responses, self.listener, self.emitter, self.listeners, self.emitters, training)

    def write(self, folder: Path, *, held_out_share: float = 0.3) -> ImportedDataset:
        """As an importer would."""
        rows = (
            Measurement(tuple(self.listeners[listener]), tuple(self.emitters[emitter]), response[0], RATE)
            for emitter, listener, response in zip(self.emitter, self.listener, self.responses, strict=True)
        )
        return ImportedDataset.write(
            folder, rows, ImportReport(), layout="test", source="A small room", held_out_share=held_out_share
        )
