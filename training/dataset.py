"""The dataset folder: `scene.toml`, and in `pairs.h5` the reflected sound of all pairs of probes, which is what follows
the direct sound and the first reflections. Those are not stored: `training.simulation.references` computes them from
the scene whenever they are needed.

Axes: emitter, listener, yaw, ear, sample. The pair of a probe with itself is absent (zeros). Samples are float16:
eleven bits beneath the level of each sample, 66 dB under the signal at every point of its decay down to 6e-5. Smaller
ones are subnormal, in steps of 6e-8: there the bits run out one by one.

Beside each response lies the energy that its diffuse part was drawn from, the same for all yaws: natural logarithms,
axes direction, band, bin. They are good to 0.03 dB. `training.simulation.expected` makes spectrograms of them.

The file also keeps the plan that it was simulated by; one from before there were plans has everything in it.
"""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from server.errors import NafirError
from training.scene_file import SceneFile
from training.simulation.plan import SimulationPlan

SPEED_OF_SOUND = 343.0
FORMAT = 3
GEOMETRIC_ORDER: Literal[1] = 1
"""Mirrored reflections of up to so many surfaces are left to geometry, as the direct sound is."""


class DatasetError(NafirError):
    """A dataset folder that is missing, unfinished or of another format."""


@dataclass(frozen=True)
class Dataset:
    """Read side of a dataset folder; `create` lays out a new one for the simulation to fill."""

    folder: Path
    scene: SceneFile
    seed: int
    probes: npt.NDArray[np.float64]
    yaws: npt.NDArray[np.float64]
    held_out: npt.NDArray[np.bool_]
    """(emitter, listener) True for pairs that training never sees."""
    effects: SimulationPlan

    @classmethod
    def create(cls, folder: Path, scene_path: Path, seed: int, effects: SimulationPlan) -> "Dataset":
        """Opens the folder if it holds the same scene, seed and plan (to resume), else makes it.

        Raises DatasetError if it holds another.
        """
        scene = SceneFile.read(scene_path)
        if (folder / "pairs.h5").exists():
            existing = cls.open(folder, finished=False)
            if existing.scene != scene or existing.seed != seed:
                raise DatasetError(f"{folder}: holds another scene or seed; choose an empty folder")
            if existing.remaining() and existing.effects.settings != effects.settings:
                raise DatasetError(f"{folder}: was begun by another plan of effects; choose an empty folder")
            if existing.remaining() and not existing.keeps_energies:
                raise DatasetError(f"{folder}: was begun when no energies were kept; choose an empty folder")
            return existing
        probes = scene.probe_positions(seed)
        yaws = 2 * np.pi * np.arange(scene.simulation.yaws) / scene.simulation.yaws
        held_out = _choose_held_out(len(probes), scene.simulation.held_out_share, np.random.default_rng([seed, 1]))
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "scene.toml").write_bytes(scene_path.read_bytes())
        samples = round(scene.simulation.duration_s * scene.simulation.sample_rate)
        shape = (len(probes), len(probes), len(yaws), 2, samples)
        # Under its own name only when whole: an interrupted start must not look like a damaged dataset.
        partial = folder / "pairs.partial"
        with h5py.File(partial, "w") as file:
            file.attrs.update(format=FORMAT, seed=seed, sample_rate=scene.simulation.sample_rate)
            file.attrs["effects"] = json.dumps(effects.to_json())
            file["probes"], file["yaws"], file["held_out"] = probes, yaws, held_out
            file.create_dataset("done", data=np.zeros(len(probes), dtype=bool))
            for name in ("reflected", "repeats"):
                file.create_dataset(name, shape, np.float16, chunks=(1, 1, *shape[2:]))
            histogram = scene.simulation.arrival_directions, len(OCTAVE_BANDS_HZ), scene.simulation.histogram_bins
            shape = (len(probes), len(probes), *histogram)
            file.create_dataset("log_energy", shape, np.float16, chunks=(1, 1, *histogram), fillvalue=-np.inf)
        partial.replace(folder / "pairs.h5")
        return cls(folder, scene, seed, probes, yaws, held_out, effects)

    @classmethod
    def open(cls, folder: Path, *, finished: bool = True) -> "Dataset":
        """Raises DatasetError if the folder is no dataset or, with `finished`, if its simulation was cut short."""
        if (folder / "responses.h5").is_file():
            raise DatasetError(f"{folder}: holds measured responses; this takes a simulated scene")
        try:
            scene = SceneFile.read(folder / "scene.toml")
            with h5py.File(folder / "pairs.h5", "r") as file:
                found = file.attrs.get("format")
                if found != FORMAT:
                    holds = ", which holds the first reflections too" if found == 2 else ""
                    raise DatasetError(
                        f"{folder}: format {found}{holds}, expected {FORMAT}: simulate into an empty folder"
                    )
                done = file["done"][()]
                dataset = cls(
                    folder,
                    scene,
                    int(file.attrs["seed"]),
                    file["probes"][()],
                    file["yaws"][()],
                    file["held_out"][()],
                    _recorded(file.attrs.get("effects"), scene),
                )
        except (OSError, KeyError, TypeError, ValueError) as exc:
            raise DatasetError(f"{folder}: not a dataset folder: {exc}") from exc
        if finished and not done.all():
            raise DatasetError(f"{folder}: {np.sum(~done)} emitters are not simulated yet; run simulate again")
        return dataset

    @property
    def sample_rate(self) -> int:
        return self.scene.simulation.sample_rate

    @property
    def samples(self) -> int:
        return round(self.scene.simulation.duration_s * self.sample_rate)

    @cached_property
    def plan(self) -> FloorPlan:
        return self.scene.geometry.floor_plan

    @cached_property
    def onset_s(self) -> npt.NDArray[np.float64]:
        """(emitter, listener) time at which sound can first arrive, round corners where it must."""
        return self.plan.path_length_m(self.probes[:, None], self.probes[None]) / SPEED_OF_SOUND

    @property
    def keeps_energies(self) -> bool:
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            return "log_energy" in file

    def remaining(self) -> list[int]:
        """Emitters not simulated yet."""
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            return [int(i) for i in np.flatnonzero(~file["done"][()])]

    def write(
        self,
        emitter: int,
        responses: npt.NDArray[np.float16],
        log_energy: npt.NDArray[np.float16],
        repeats: dict[int, npt.NDArray[np.float16]],
    ) -> None:
        """Stores all listeners of one emitter (listener, yaw, ear, sample) with their (listener, direction, band, bin)
        logarithms of energy, and second takes of its held-out pairs by listener."""
        with h5py.File(self.folder / "pairs.h5", "r+") as file:
            file["reflected"][emitter] = responses
            file["log_energy"][emitter] = log_energy
            for listener, repeat in repeats.items():
                file["repeats"][emitter, listener] = repeat
            file.flush()
            file["done"][emitter] = True

    def pairs(self, *, held_out: bool) -> npt.NDArray[np.int64]:
        """(pair, 2) emitter and listener of the held-out pairs or of all others."""
        chosen = self.held_out if held_out else ~self.held_out & ~np.eye(len(self.probes), dtype=bool)
        return np.argwhere(chosen)

    def read(self, pairs: npt.NDArray[np.int64], name: str = "reflected") -> npt.NDArray[np.float16]:
        """(pair, yaw, ear, sample) reflected sound, or second takes with `name` "repeats"."""
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            return np.stack([file[name][emitter, listener] for emitter, listener in pairs])

    def read_energy(self, pairs: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """(pair, direction, band, bin) energy that the diffuse part of `reflected` was drawn from.

        Raises DatasetError for a dataset that was simulated before energies were kept.
        """
        if not self.keeps_energies:
            raise DatasetError(f"{self.folder}: holds no energies; simulate into an empty folder")
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            logarithms = np.stack([file["log_energy"][emitter, listener] for emitter, listener in pairs])
        return np.exp(logarithms.astype(np.float32))


def _recorded(effects: str | None, scene: SceneFile) -> SimulationPlan:
    if effects is None:
        return SimulationPlan.everything(scene.simulation.image_order, scene.simulation.rays, diffraction=False)
    return SimulationPlan.from_json(json.loads(effects))


def _choose_held_out(probes: int, share: float, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """(emitter, listener); both directions of a chosen couple, or its training twin would give the answer away by
    reciprocity."""
    first, second = np.triu_indices(probes, 1)
    chosen = rng.choice(len(first), max(1, round(share * len(first))), replace=False)
    held_out = np.zeros((probes, probes), dtype=bool)
    held_out[first[chosen], second[chosen]] = held_out[second[chosen], first[chosen]] = True
    return held_out
