"""The folder of a bake: a level's scene, its simulated data, the run of its field and the bundle, each in its own
folder, and `bake.json`, which says what the scene was imported from and which run is in the bundle.

A stage that is finished is not made again. One that was made of something else than what is given now is told.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path

from pydantic import ValidationError

from server.core.errors import NafirError
from server.scene.bundle import MANIFEST_FILE
from server.scene.geometry import Strict
from training.data.dataset import Dataset
from training.data.levels.level_import import Choices, read_level
from training.data.levels.level_scene import SCENE_FILE, LevelScene, is_same_scene
from training.learning.runs import CHECKPOINT, Configuration, is_finished

RECORD_FILE = "bake.json"
_OPTIONS = {
    "units": "--units",
    "up": "--up",
    "handedness": "--handedness",
    "scene": "--scene",
    "default_material": "--default-material",
    "is_open": "--open",
    "merge_within_m": "--merge-within-m",
    "sample_rate": "--sample-rate",
    "rays": "--rays",
    "probes": "--probes",
    "seed": "--seed",
}
_LENGTHS = {"epochs": "--epochs", "minutes": "--minutes", "seed": "--seed"}


class BakeError(NafirError):
    """The error for a folder that holds something else than this bake."""


class Stage(Enum):
    """The stages in their order. The value is the folder that each fills."""

    IMPORT = "scene"
    SIMULATE = "data"
    TRAIN = "run"
    EXPORT = "bundle"


class _Record(Strict):
    """`imported` is what the scene was imported from, by name, and `scene` its digest then; None before the import.
    `exported` is the digest of the run that the bundle holds."""

    imported: dict[str, str] | None = None
    scene: str | None = None
    exported: str | None = None


@dataclass(frozen=True)
class Bake:
    """A bake into `folder` of a level that is read by these choices, whose field is trained by this configuration."""

    folder: Path
    level: Path
    choices: Choices
    configuration: Configuration

    def path(self, stage: Stage) -> Path:
        return self.folder / stage.value

    def claim(self) -> None:
        """Makes the folder, or goes on with it. Raises LevelError for a file that is no level, and BakeError for a
        folder that holds something else."""
        _ = self._sources
        if (self.folder / RECORD_FILE).exists():
            return
        if self.folder.exists() and any(self.folder.iterdir()):
            raise BakeError(f"{self.folder}: holds something else, and no {RECORD_FILE}: choose an empty folder")
        self.folder.mkdir(parents=True, exist_ok=True)
        self._write(_Record())

    def changes(self, stage: Stage) -> list[str]:
        """What a stage is made of that is not as it was when it began; nothing if it did not."""
        if stage is Stage.IMPORT:
            return _changed(self._record.imported, self._sources)
        if stage is Stage.SIMULATE and (self.path(stage) / "pairs.h5").exists():
            data, scene = Dataset.open(self.path(stage), finished=False), LevelScene.read(self.path(Stage.IMPORT))
            changed = {
                f"{Stage.IMPORT.value}/{SCENE_FILE} or its meshes": not is_same_scene(data.place, scene),
                "--seed": data.seed != self.choices.seed,
            }
            return [name for name, is_changed in changed.items() if is_changed]
        if stage is Stage.TRAIN and (self.path(stage) / "run.json").exists():
            begun = Configuration.read(self.path(stage))
            if begun != self.configuration:
                changed = {
                    name: getattr(begun, key) != getattr(self.configuration, key) for key, name in _LENGTHS.items()
                }
                return [name for name, is_changed in changed.items() if is_changed] or ["how fields are trained"]
        return []

    def is_finished(self, stage: Stage) -> bool:
        """Whether there is nothing left to do in a stage of which nothing has changed."""
        path = self.path(stage)
        if stage is Stage.IMPORT:
            return self._record.imported is not None and (path / SCENE_FILE).exists()
        if stage is Stage.SIMULATE:
            return (path / "pairs.h5").exists() and not Dataset.open(path, finished=False).remaining()
        if stage is Stage.TRAIN:
            return (path / CHECKPOINT).exists() and is_finished(path)
        return (path / MANIFEST_FILE).exists() and self._record.exported == self._run_digest

    def note_import(self) -> None:
        """Notes what the scene that is there now was imported from."""
        self._write(_Record(imported=self._sources, scene=self._scene_digest, exported=self._record.exported))

    def note_export(self) -> None:
        """Notes that the bundle that is there now is of the run."""
        self._write(self._record.model_copy(update={"exported": self._run_digest}))

    def drop(self, stage: Stage) -> None:
        """Forgets a stage, and drops the data and the run that follow from it. A bundle stays, to be served until there
        is another one. Raises BakeError for a scene that was changed by hand."""
        if stage is Stage.IMPORT:
            if self.is_finished(stage) and self._record.scene != self._scene_digest:
                raise BakeError(
                    f"{self.path(stage) / SCENE_FILE}: was changed by hand, and importing the level anew would lose "
                    "that: bake into an empty folder, and change it there too"
                )
            self._write(_Record(exported=self._record.exported))
            return
        for later in (Stage.SIMULATE, Stage.TRAIN) if stage is Stage.SIMULATE else (Stage.TRAIN,):
            if self.path(later).exists():
                shutil.rmtree(self.path(later))

    @cached_property
    def _sources(self) -> dict[str, str]:
        """All that decides what a scene is, by the name by which it is told."""
        source, _, _ = read_level(self.level, self.choices)
        materials = self.choices.materials
        return {
            "the level": f"{self.level.stem} {source.digest}",
            "--materials": "" if materials is None else hashlib.sha256(materials.read_bytes()).hexdigest(),
            **{option: str(getattr(self.choices, name)) for name, option in _OPTIONS.items()},
        }

    @property
    def _scene_digest(self) -> str:
        identity = LevelScene.read(self.path(Stage.IMPORT)).identity
        return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()

    @property
    def _run_digest(self) -> str:
        return hashlib.sha256((self.path(Stage.TRAIN) / CHECKPOINT).read_bytes()).hexdigest()

    @property
    def _record(self) -> _Record:
        path = self.folder / RECORD_FILE
        try:
            return _Record.model_validate_json(path.read_text(encoding="utf-8"))
        except ValidationError as exc:
            raise BakeError(f"{path}: is not the record of a bake: bake into an empty folder") from exc

    def _write(self, record: _Record) -> None:
        partial = self.folder / "bake.partial"
        partial.write_text(record.model_dump_json(indent=2) + "\n", encoding="utf-8")
        partial.replace(self.folder / RECORD_FILE)


def _changed(before: Mapping[str, str] | None, now: Mapping[str, str]) -> list[str]:
    return [] if before is None else [name for name in now if before.get(name) != now[name]]
