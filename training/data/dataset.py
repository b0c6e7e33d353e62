"""The dataset folder: `scene.toml`, and in `pairs.h5` the late reverberation between all pairs of probes. The direct
sound and the first reflections are not stored: `training.simulation.references` computes them from the scene when they
are needed.

Axes: emitter, listener, yaw, ear, sample. The pair of a probe with itself is absent (zeros). Samples are float16:
eleven bits at the level of each sample, 66 dB of signal-to-noise ratio at every point of the decay down to 6e-5.
Smaller samples are subnormal, in steps of 6e-8, and lose precision as they become smaller.

The file also stores, for each response, the energies that its diffuse part was drawn from, the same for all yaws:
natural logarithms, axes direction, band, bin, exact to 0.03 dB. `training.simulation.expected` makes spectrograms of
them.

If the simulation plan has one tail for all pairs, the tail is stored once. Each pair then stores only what comes before
the tail, and the sample of the tail's noise that its response begins with. Reading gives whole responses.

The file keeps the plan that it was simulated by. A file that is older than plans was simulated with every effect on.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from training.data.dataset_check import DatasetError, require_finite_pairs
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.data.shared_tail import FADE_S, SharedTail
from training.data.simulation_plan import SimulationPlan

SPEED_OF_SOUND = 343.0
FORMAT = 4
_READABLE = (3, FORMAT)
"""In format 3 every pair has a tail of its own."""
GEOMETRIC_ORDER: Literal[1] = 1
"""Reflections of up to this order are computed from geometry, as the direct sound is, and not stored."""
TAKES = ("reflected", "repeats")
"""The second take is a second simulation of the held-out pairs, which tells how repeatable the first is."""
# Filters of a single arrival ring for less than this.
_FILTER_S = 0.020


def own_duration_s(scene: SceneFile, plan: SimulationPlan) -> float:
    """The length of what each pair stores: the whole response, or, where pairs share a tail, the part until the tail
    has set in and all image sources have been heard, in whole histogram bins."""
    if plan.tail_start_s is None:
        return scene.simulation.duration_s
    sides_m = *np.ptp(scene.geometry.corners, axis=0), scene.geometry.height_m
    last_image_s = (plan.image_order + 1) * math.hypot(*sides_m) / SPEED_OF_SOUND + _FILTER_S
    bins = math.ceil(max(plan.tail_start_s + FADE_S, last_image_s) / HISTOGRAM_BIN_S)
    return min(scene.simulation.duration_s, HISTOGRAM_BIN_S * bins)


class OwnResponse(NamedTuple):
    """The samples (yaw, ear, sample) of one pair, `own_duration_s` long, and the sample of the shared tail's noise that
    its tail begins with."""

    samples: npt.NDArray[np.float16]
    tail_begin: int


@dataclass(frozen=True)
class Dataset:
    """A dataset folder that is open for reading. `create` makes a new one, which the simulation fills."""

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
        """Makes the folder, or opens it to resume if it holds the same scene, seed and plan.

        Raises DatasetError if the folder holds another scene, seed or plan.
        """
        scene = SceneFile.read(scene_path)
        if (folder / "pairs.h5").exists():
            existing = cls.open(folder, finished=False)
            if existing.scene != scene or existing.seed != seed:
                raise DatasetError(f"{folder}: holds another scene or seed; choose an empty folder")
            if existing.remaining() and existing.effects.settings != effects.settings:
                raise DatasetError(f"{folder}: was begun with another plan of effects; choose an empty folder")
            if existing.remaining() and not existing.stores_energies:
                raise DatasetError(f"{folder}: was begun without energies; choose an empty folder")
            if existing.remaining() and not existing.stores_tail_once:
                raise DatasetError(f"{folder}: was begun in format {_READABLE[0]}; choose an empty folder")
            return existing
        probes = scene.probe_positions(seed)
        yaws = 2 * np.pi * np.arange(scene.simulation.yaws) / scene.simulation.yaws
        held_out = _choose_held_out(len(probes), scene.simulation.held_out_share, np.random.default_rng([seed, 1]))
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "scene.toml").write_bytes(scene_path.read_bytes())
        own_s = own_duration_s(scene, effects)
        samples = round(own_s * scene.simulation.sample_rate)
        shape = (len(probes), len(probes), len(yaws), 2, samples)
        # The file gets its final name when it is whole: an interrupted start must not look like a damaged dataset.
        partial = folder / "pairs.partial"
        with h5py.File(partial, "w") as file:
            file.attrs.update(format=FORMAT, seed=seed, sample_rate=scene.simulation.sample_rate)
            file.attrs["effects"] = json.dumps(effects.to_json())
            file["probes"], file["yaws"], file["held_out"] = probes, yaws, held_out
            file.create_dataset("done", data=np.zeros(len(probes), dtype=bool))
            for name in TAKES:
                file.create_dataset(name, shape, np.float16, chunks=(1, 1, *shape[2:]))
            file.create_dataset("tail_begin", (len(TAKES), *shape[:2]), np.int32)
            histogram = scene.simulation.arrival_directions, len(OCTAVE_BANDS_HZ), round(own_s / HISTOGRAM_BIN_S)
            shape = (len(probes), len(probes), *histogram)
            file.create_dataset("log_energy", shape, np.float16, chunks=(1, 1, *histogram), fillvalue=-np.inf)
        partial.replace(folder / "pairs.h5")
        return cls(folder, scene, seed, probes, yaws, held_out, effects)

    @classmethod
    def open(cls, folder: Path, *, finished: bool = True) -> "Dataset":
        """Raises DatasetError if the folder is not a dataset or, with `finished`, if its simulation is not finished or
        its arrays hold impossible values (`training.data.dataset_check`)."""
        if (folder / "responses.h5").is_file():
            raise DatasetError(f"{folder}: holds measured responses; this takes a simulated scene")
        try:
            scene = SceneFile.read(folder / "scene.toml")
            with h5py.File(folder / "pairs.h5", "r") as file:
                found = file.attrs.get("format")
                if found not in _READABLE:
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
                    _plan_from(file.attrs.get("effects"), scene),
                )
        except (OSError, KeyError, TypeError, ValueError) as exc:
            raise DatasetError(f"{folder}: not a dataset folder: {exc}") from exc
        if finished and not done.all():
            raise DatasetError(f"{folder}: {np.sum(~done)} emitters are not simulated yet; run simulate again")
        if finished:
            dataset._require_valid_arrays()
        return dataset

    def _require_valid_arrays(self) -> None:
        path = self.folder / "pairs.h5"
        for name, values, shape in (
            ("probes", self.probes, (len(self.probes), 3)),
            ("yaws", self.yaws, (self.scene.simulation.yaws,)),
            ("held_out", self.held_out, (len(self.probes), len(self.probes))),
        ):
            if values.shape != shape or not np.isfinite(values).all():
                raise DatasetError(f"{path}: {name}: has shape {values.shape}, expected {shape} of finite values")
        samples = round(own_duration_s(self.scene, self.effects) * self.sample_rate)
        try:
            with h5py.File(path, "r") as file:
                require_finite_pairs(
                    path, file, probes=len(self.probes), yaws=len(self.yaws), samples=samples, takes=TAKES
                )
        except (OSError, KeyError, TypeError, ValueError) as exc:
            raise DatasetError(f"{path}: cannot be read: {exc}") from exc

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
        """(emitter, listener) seconds until the first sound can arrive, along the shortest path around corners."""
        return self.plan.path_length_m(self.probes[:, None], self.probes[None]) / SPEED_OF_SOUND

    @property
    def stores_energies(self) -> bool:
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            return "log_energy" in file

    @property
    def stores_tail_once(self) -> bool:
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            return bool(file.attrs["format"] == FORMAT)

    def remaining(self) -> list[int]:
        """Numbers of the emitters that are not simulated yet."""
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            return [int(i) for i in np.flatnonzero(~file["done"][()])]

    def write_tail(self, tail: SharedTail) -> None:
        """Stores the shared tail once, before any pair."""
        with h5py.File(self.folder / "pairs.h5", "r+") as file:
            if "tail" in file:
                return
            file.pop("tail.partial", None)
            group = file.create_group("tail.partial")
            for name, value in vars(tail).items():
                group[name] = value
            file.flush()
            file.move("tail.partial", "tail")

    def write(
        self,
        emitter: int,
        takes: Sequence[Mapping[int, OwnResponse]],
        log_energy: npt.NDArray[np.float16],
    ) -> None:
        """Stores the responses of one emitter: for each take, responses by listener (the second take has the held-out
        listeners only), and the log energies (listener, direction, band, bin) of the first take."""
        with h5py.File(self.folder / "pairs.h5", "r+") as file:
            for number, (name, responses) in enumerate(zip(TAKES, takes, strict=True)):
                pairs, begins = file[name], file["tail_begin"][number, emitter]
                for listener, (samples, begins[listener]) in responses.items():
                    # A chunk is exactly one response, so HDF5 need not copy it first.
                    chunk = np.ascontiguousarray(samples, pairs.dtype)
                    pairs.id.write_direct_chunk((emitter, listener, 0, 0, 0), chunk)
                file["tail_begin"][number, emitter] = begins
            file["log_energy"][emitter] = log_energy
            file.flush()
            file["done"][emitter] = True

    def pairs(self, *, held_out: bool) -> npt.NDArray[np.int64]:
        """(pair, 2) emitter and listener of each held-out pair or, without `held_out`, of each training pair."""
        chosen = self.held_out if held_out else ~self.held_out & ~np.eye(len(self.probes), dtype=bool)
        return np.argwhere(chosen)

    @cached_property
    def tail(self) -> SharedTail | None:
        """The tail that all pairs share, or None if each pair has its own."""
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            if "tail" not in file:
                return None
            stored = {name: value[()] for name, value in file["tail"].items()}
        return SharedTail(**{**stored, "start_s": float(stored["start_s"]), "first": int(stored["first"])})

    def read(self, pairs: npt.NDArray[np.int64], take: str = "reflected") -> npt.NDArray[np.float32]:
        """(pair, yaw, ear, sample) late reverberation of one of the TAKES."""
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            responses = StoredResponses(self, file, take)
            return np.stack([responses[emitter, listener] for emitter, listener in pairs])

    def read_energy(self, pairs: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """(pair, direction, band, bin) energies that the diffuse part of the take `reflected` was drawn from.

        Raises DatasetError for a dataset that was simulated without storing energies.
        """
        if not self.stores_energies:
            raise DatasetError(f"{self.folder}: has no energies; simulate into an empty folder")
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            logarithms = np.stack([file["log_energy"][emitter, listener] for emitter, listener in pairs])
        energies = np.exp(logarithms.astype(np.float32))
        return energies if self.tail is None else np.stack([self.tail.join(0, energy) for energy in energies])


class StoredResponses:
    """Reads the late reverberation of one of the TAKES from an open dataset `file`, by emitter and listener."""

    def __init__(self, dataset: Dataset, file: h5py.File, take: str = "reflected") -> None:
        self._own: h5py.Dataset = file[take]
        self._take = TAKES.index(take)
        self._tail = dataset.tail
        self._begins = None if self._tail is None else file["tail_begin"][self._take]

    def __getitem__(self, ends: tuple[int, int]) -> npt.NDArray[np.float32]:
        """(yaw, ear, sample)"""
        own = self._own[ends]
        if self._tail is None or self._begins is None:
            return np.asarray(own, np.float32)
        return self._tail.extend(self._take, own, int(self._begins[ends]))


def _plan_from(effects: str | None, scene: SceneFile) -> SimulationPlan:
    if effects is None:
        return SimulationPlan.everything(scene.simulation.image_order, scene.simulation.rays, diffraction=False)
    return SimulationPlan.from_json(json.loads(effects))


def _choose_held_out(probes: int, share: float, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """(emitter, listener) True for a random share of the couples of probes. Both directions of a couple are held out,
    because by reciprocity the one would reveal the other."""
    first, second = np.triu_indices(probes, 1)
    chosen = rng.choice(len(first), max(1, round(share * len(first))), replace=False)
    held_out = np.zeros((probes, probes), dtype=bool)
    held_out[first[chosen], second[chosen]] = held_out[second[chosen], first[chosen]] = True
    return held_out
