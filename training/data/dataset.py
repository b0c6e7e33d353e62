"""The dataset folder: `scene.toml`, and in `pairs.h5` the energies of late reverberation between all pairs of probes.

No response is stored. `training.simulation.references` makes the response of any head, turned in any way, from these
energies, and computes the direct sound and the reflections that are mirrored from the scene.

Energies are natural logarithms in float16, exact to 0.03 dB, with the axes take, emitter, listener, direction, band and
bin. The pair of a probe with itself is absent. The second take has the held-out pairs only.

If the simulation plan has one tail for all pairs, the energies of the tail are stored once for each take of the
held-out pairs, and once more, traced anew, for the pairs to train on. Each pair then stores only what comes before the
tail. Reading gives the energies of whole responses.

In a level with doors, each emitter is simulated with the doors in a state of its own, drawn at random
(`training.data.door_states`). Such a file has another format, with the arrays `openness` (emitter, door) and `unseen`
(emitter,). If emitters are heard at some of the probes only, the format is a third one, with the array `heard`
(emitter, listener).

The file keeps the plan that it was simulated by.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from server.acoustics.surroundings import PlanSurroundings, Surroundings
from training.data.dataset_check import DatasetError, require_possible_energies
from training.data.door_states import DoorStates, EmitterScenes
from training.data.levels.level_scene import SCENE_FILE, LevelScene, is_same_scene, read_scene
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.data.shared_tail import FADE_S, SharedTail
from training.data.simulated_scene import SimulatedScene
from training.data.simulation_plan import SimulationPlan

SPEED_OF_SOUND = 343.0
FORMAT = 5
DOORS_FORMAT = 6
"""The format of datasets whose doors move."""
SOME_FORMAT = 7
"""The format of datasets whose emitters are heard at some of the probes only."""
Half = Literal["choice", "report"]
"""Halves of the held-out pairs: quality levels are chosen by one, and their errors are reported on the other."""
GEOMETRIC_ORDER: Literal[1] = 1
"""Reflections of up to this order are computed from geometry, as the direct sound is, and no field learns them."""
TAKES = ("reflected", "repeats")
"""The second take is a second simulation of the held-out pairs, which tells how repeatable the first is."""
_HOLDS = {2: "the first reflections too", 3: "responses of one head", 4: "responses of one head"}
"""What files of earlier formats hold that is not read any more."""


def own_duration_s(scene: SimulatedScene, plan: SimulationPlan) -> float:
    """The length of the energies that each pair stores: the whole response, or, where pairs share a tail, the part
    until the tail has set in, in whole histogram bins."""
    if plan.tail_start_s is None:
        return scene.simulation.duration_s
    bins = math.ceil((plan.tail_start_s + FADE_S) / HISTOGRAM_BIN_S)
    return min(scene.simulation.duration_s, HISTOGRAM_BIN_S * bins)


@dataclass(frozen=True)
class Dataset:
    """A dataset folder that is open for reading. `create` makes a new one, which the simulation fills."""

    folder: Path
    place: SceneFile | LevelScene
    seed: int
    probes: npt.NDArray[np.float64]
    yaws: npt.NDArray[np.float64]
    held_out: npt.NDArray[np.bool_]
    """(emitter, listener) True for pairs that training never sees."""
    effects: SimulationPlan
    states: DoorStates
    heard: npt.NDArray[np.bool_]
    """(emitter, listener) True for pairs that may be simulated."""

    @classmethod
    def create(cls, folder: Path, scene_path: Path, seed: int, effects: SimulationPlan) -> "Dataset":
        """Makes the folder, or opens it to resume if it holds the same scene, seed and plan.

        Raises DatasetError if the folder holds another scene, seed or plan.
        """
        scene = read_scene(scene_path)
        if (folder / "pairs.h5").exists():
            existing = cls.open(folder, finished=False)
            if not is_same_scene(existing.place, scene) or existing.seed != seed:
                raise DatasetError(f"{folder}: holds another scene or seed; choose an empty folder")
            if existing.remaining() and existing.effects.settings != effects.settings:
                raise DatasetError(f"{folder}: was begun with another plan of effects; choose an empty folder")
            return existing
        probes = scene.probe_positions(seed)
        yaws = 2 * np.pi * np.arange(scene.simulation.yaws) / scene.simulation.yaws
        states, rng = DoorStates.of(scene, len(probes), seed), np.random.default_rng([seed, 1])
        has_doors = states.openness.shape[1] > 0
        if has_doors:
            held_out = states.held_out(rng)
        else:
            held_out = _choose_held_out(len(probes), scene.simulation.held_out_share, rng)
        heard = _choose_heard(len(probes), scene.simulation.listeners, np.random.default_rng([seed, 15]))
        held_out &= heard
        folder.mkdir(parents=True, exist_ok=True)
        scene_path = scene_path / SCENE_FILE if scene_path.is_dir() else scene_path
        (folder / SCENE_FILE).write_bytes(scene_path.read_bytes())
        if isinstance(scene, LevelScene):
            scene.copy_meshes(scene_path.parent, folder)
        # The file gets its final name when it is whole: an interrupted start must not look like a damaged dataset.
        partial = folder / "pairs.partial"
        with h5py.File(partial, "w") as file:
            hears_some = scene.simulation.listeners is not None
            version = SOME_FORMAT if hears_some else DOORS_FORMAT if has_doors else FORMAT
            file.attrs.update(format=version, seed=seed, sample_rate=scene.simulation.sample_rate)
            file.attrs["effects"] = json.dumps(effects.to_json())
            file["probes"], file["yaws"], file["held_out"] = probes, yaws, held_out
            if has_doors:
                file["openness"], file["unseen"] = states.openness, states.unseen
            if hears_some:
                file["heard"] = heard
            file.create_dataset("done", data=np.zeros(len(probes), dtype=bool))
            histogram = _histogram(scene, effects)
            file.create_dataset(
                "log_energy",
                (len(TAKES), len(probes), len(probes), *histogram),
                np.float16,
                chunks=(1, 1, 1, *histogram),
                fillvalue=-np.inf,
            )
        partial.replace(folder / "pairs.h5")
        return cls(folder, scene, seed, probes, yaws, held_out, effects, states, heard)

    @classmethod
    def open(cls, folder: Path, *, finished: bool = True) -> "Dataset":
        """Raises DatasetError if the folder is not a dataset or, with `finished`, if its simulation is not finished or
        its arrays hold impossible values (`training.data.dataset_check`)."""
        if (folder / "responses.h5").is_file():
            raise DatasetError(f"{folder}: holds measured responses; this takes a simulated scene")
        try:
            scene = read_scene(folder / SCENE_FILE)
            with h5py.File(folder / "pairs.h5", "r") as file:
                found = file.attrs.get("format")
                if found not in (FORMAT, DOORS_FORMAT, SOME_FORMAT):
                    holds = f", which holds {_HOLDS[found]}" if found in _HOLDS else ""
                    raise DatasetError(
                        f"{folder}: format {found}{holds}, expected {FORMAT} to {SOME_FORMAT}: "
                        "simulate into an empty folder"
                    )
                done, probes = file["done"][()], file["probes"][()]
                states = DoorStates(file["openness"][()], file["unseen"][()]) if "openness" in file else None
                hears_all = np.ones((len(probes), len(probes)), dtype=bool)
                dataset = cls(
                    folder,
                    scene,
                    int(file.attrs["seed"]),
                    probes,
                    file["yaws"][()],
                    file["held_out"][()],
                    SimulationPlan.from_json(json.loads(file.attrs["effects"])),
                    states or DoorStates.none(len(probes)),
                    file["heard"][()] if found == SOME_FORMAT else hears_all,
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
            ("yaws", self.yaws, (self.place.simulation.yaws,)),
            ("held_out", self.held_out, (len(self.probes), len(self.probes))),
            ("openness", self.states.openness, (len(self.probes), self._doors)),
            ("unseen", self.states.unseen, (len(self.probes),)),
            ("heard", self.heard, (len(self.probes), len(self.probes))),
        ):
            if values.shape != shape or not np.isfinite(values).all():
                raise DatasetError(f"{path}: {name}: has shape {values.shape}, expected {shape} of finite values")
        if np.any((self.states.openness < 0) | (self.states.openness > 1)):
            raise DatasetError(f"{path}: openness: is not from 0 to 1 everywhere; simulate into an empty folder")
        pairs = len(TAKES), len(self.probes), len(self.probes)
        try:
            with h5py.File(path, "r") as file:
                require_possible_energies(path, file, (*pairs, *_histogram(self.place, self.effects)))
        except (OSError, KeyError, TypeError, ValueError) as exc:
            raise DatasetError(f"{path}: cannot be read: {exc}") from exc

    @property
    def scene(self) -> SceneFile:
        """The scene file of a floor plan. Raises DatasetError for a level."""
        if not isinstance(self.place, SceneFile):
            raise DatasetError(f"{self.folder}: holds a level, and this takes a floor plan so far")
        return self.place

    @property
    def sample_rate(self) -> int:
        return self.place.simulation.sample_rate

    @property
    def samples(self) -> int:
        return round(self.place.simulation.duration_s * self.sample_rate)

    @cached_property
    def plan(self) -> FloorPlan:
        return self.scene.geometry.floor_plan

    @cached_property
    def surroundings(self) -> Surroundings:
        """The geometry of the place."""
        return self.place.surroundings if isinstance(self.place, LevelScene) else PlanSurroundings(self.plan)

    @cached_property
    def onset_s(self) -> npt.NDArray[np.float64]:
        """(emitter, listener) seconds until the first sound can arrive, along the shortest path around corners."""
        length_m = np.empty((len(self.probes), len(self.probes)))
        for one, emitters in self.scenes.groups(np.arange(len(self.probes))).items():
            length_m[emitters] = self.scenes.of(one).path_length_m(self.probes[emitters, None], self.probes[None])
        return length_m / SPEED_OF_SOUND

    @cached_property
    def scenes(self) -> EmitterScenes:
        """The place as each emitter finds it."""
        return EmitterScenes(self.place, self.states)

    @property
    def _doors(self) -> int:
        """The number of doors that move."""
        return int(self.states.openness.shape[1])

    @property
    def doors(self) -> tuple[str, ...]:
        """The names of the doors that move."""
        return tuple(door.name for door in self.place.file.geometry.doors) if self._doors else ()  # type: ignore[union-attr]

    @cached_property
    def trained(self) -> npt.NDArray[np.bool_]:
        """(emitter, listener) True for pairs to train on. Neither these nor held out are a probe with itself, pairs in
        unseen states of doors whose reverse is trained on, and the reverse of pairs that are held out."""
        held_out = self.held_out | self.held_out.T
        return self.heard & ~held_out & ~np.eye(len(self.probes), dtype=bool) & ~self.states.unseen[:, None]

    def is_visible(self, pairs: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """(pair,) whether emitter and listener of pairs (pair, 2) see each other."""
        visible = np.zeros(len(pairs), dtype=bool)
        for one, here in self.scenes.groups(pairs[:, 0]).items():
            scene, (emitter, listener) = self.scenes.of(one), pairs[here].T
            surroundings = scene.surroundings if isinstance(scene, LevelScene) else self.surroundings
            visible[here] = surroundings.is_visible(self.probes[emitter], self.probes[listener])
        return visible

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

    def write(self, emitter: int, takes: Sequence[Mapping[int, npt.NDArray[np.float16]]]) -> None:
        """Stores the log energies of one emitter: for each take, (direction, band, bin) by listener. The second take
        has the held-out listeners only."""
        with h5py.File(self.folder / "pairs.h5", "r+") as file:
            stored = file["log_energy"]
            for number, logarithms in enumerate(takes):
                for listener, values in logarithms.items():
                    # A chunk is exactly one pair, so HDF5 need not copy it first.
                    chunk = np.ascontiguousarray(values, stored.dtype)
                    stored.id.write_direct_chunk((number, emitter, listener, 0, 0, 0), chunk)
            file.flush()
            file["done"][emitter] = True

    def pairs(self, *, held_out: bool) -> npt.NDArray[np.int64]:
        """(pair, 2) emitter and listener of each held-out pair or, without `held_out`, of each training pair."""
        return np.argwhere(self.held_out if held_out else self.trained)

    def held_out_half(self, half: Half) -> npt.NDArray[np.int64]:
        """(pair, 2) emitter and listener of a random half of the held-out pairs: what is chosen by one half is reported
        on the other. Both directions of a couple are in the same half; a single couple is in both."""
        pairs = self.pairs(held_out=True)
        couples, couple = np.unique(np.sort(pairs, axis=1), axis=0, return_inverse=True)
        shuffled = np.random.default_rng([self.seed, 13]).permutation(len(couples))
        first = shuffled[: max(1, len(couples) // 2)]
        chosen = first if half == "choice" else shuffled[min(len(first), len(couples) - 1) :]
        return pairs[np.isin(couple.reshape(-1), chosen)]

    @cached_property
    def tail(self) -> SharedTail | None:
        """The tail that all pairs share, or None if each pair has its own."""
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            if "tail" not in file:
                return None
            stored = {name: value[()] for name, value in file["tail"].items()}
        return SharedTail(float(stored["start_s"]), stored["energies"])

    def read_energy(self, pairs: npt.NDArray[np.int64], take: str = TAKES[0]) -> npt.NDArray[np.float32]:
        """(pair, direction, band, bin) energies of the late reverberation in one of the TAKES."""
        number = TAKES.index(take)
        with h5py.File(self.folder / "pairs.h5", "r") as file:
            logarithms = np.stack([file["log_energy"][number, emitter, listener] for emitter, listener in pairs])
        energies = np.exp(logarithms.astype(np.float32))
        tail = self.tail
        if tail is None:
            return energies
        numbers = [tail.number(number, held_out=bool(self.held_out[emitter, listener])) for emitter, listener in pairs]
        return np.stack([tail.join(*of_pair) for of_pair in zip(numbers, energies, strict=True)])


def _histogram(scene: SceneFile | LevelScene, plan: SimulationPlan) -> tuple[int, int, int]:
    """The shape (direction, band, bin) of the energies that each pair stores."""
    bins = round(own_duration_s(scene, plan) / HISTOGRAM_BIN_S)
    return scene.simulation.arrival_directions, len(OCTAVE_BANDS_HZ), bins


def _choose_heard(probes: int, listeners: int | None, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """(emitter, listener) True for so many listeners of each emitter, drawn at random; for None, for all."""
    if listeners is None or listeners >= probes - 1:
        return np.ones((probes, probes), dtype=bool)
    order = rng.random((probes, probes))
    np.fill_diagonal(order, np.inf)
    return np.argsort(np.argsort(order, axis=1), axis=1) < listeners


def _choose_held_out(probes: int, share: float, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """(emitter, listener) True for a random share of the couples of probes. Both directions of a couple are held out,
    because by reciprocity the one would reveal the other."""
    first, second = np.triu_indices(probes, 1)
    chosen = rng.choice(len(first), max(1, round(share * len(first))), replace=False)
    held_out = np.zeros((probes, probes), dtype=bool)
    held_out[first[chosen], second[chosen]] = held_out[second[chosen], first[chosen]] = True
    return held_out
