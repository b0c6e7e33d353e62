"""Makes bundles of scenes of many kinds, from their files with default settings, and compares reverberation times with
other programs: `python -m training.trials.own_scenes FOLDER [SCENE.toml ...]`, `make own-scenes`.

A finished scene is stored as `report.json` in its folder, and an interrupted run can be resumed. At the end, a table is
printed and written to FOLDER.md. The exit code is 1 if a scene has no bundle, or if a reverberation time is beyond a
limit.
"""

import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from training.data.scene_file import SceneFile
from training.trials.field_decay import FieldDecay, field_decay
from training.trials.reverberation import Comparison, compare, worst_of

OWN = Path(__file__).parents[1] / "scenes" / "own"
_TRAIN = "import sys; from training.cli.main import main; sys.argv[0] = 'nafir-train'; main()"
_CHECK = "import sys; from server.cli.main import main; sys.argv[0] = 'nafir'; main()"


@dataclass(frozen=True)
class Report:
    """The results of one scene. `minutes` are wall-clock times by step. `problem` is what stopped it, if anything did;
    then `comparison` and `field` are None."""

    scene: str
    minutes: dict[str, float]
    problem: str | None
    comparison: Comparison | None = None
    field: FieldDecay | None = None

    @property
    def passed(self) -> bool:
        return not self.faults()

    def faults(self) -> list[str]:
        """What stopped the scene, or the limits that it exceeds."""
        if self.comparison is None or self.field is None:
            return [self.problem or "not compared"]
        return self.comparison.beyond() + self.field.beyond()


def make(scene: Path, folder: Path) -> Report:
    """Runs all steps of one scene with default settings; finished scenes are not run again."""
    digest = hashlib.sha256(scene.read_bytes()).hexdigest()
    kept = folder / "report.json"
    if kept.is_file():
        document = json.loads(kept.read_text())
        if document.pop("scene_sha256") == digest:
            comparison = Comparison(**_with_tuples(document.pop("comparison")))
            field = FieldDecay(**_with_tuples(document.pop("field")))
            return Report(**document, comparison=comparison, field=field)
    folder.mkdir(parents=True, exist_ok=True)
    data, run, bundle = (str(folder / name) for name in ("data", "run", "bundle"))
    commands = {
        "simulate": (_TRAIN, "simulate", str(scene), "-o", data),
        "train": (_TRAIN, "train", data, "-o", run),
        "export": (_TRAIN, "export", run, "-o", bundle),
        "check": (_CHECK, "check", bundle),
    }
    minutes: dict[str, float] = {}
    for step, (program, *arguments) in commands.items():
        began_s = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-c", program, *arguments], check=False, stdout=subprocess.PIPE, text=True
        )
        minutes[step] = round((time.monotonic() - began_s) / 60, 2)
        if done.returncode:
            # Not stored, so that the next run tries again.
            return Report(scene.stem, minutes, f"{step} failed with exit code {done.returncode}")
    comparison, field = compare(SceneFile.read(scene)), field_decay(Path(bundle), Path(data))
    report = Report(scene.stem, minutes, None, comparison, field)
    kept.write_text(json.dumps({"scene_sha256": digest, **asdict(report)}, indent=2) + "\n")
    return report


def _with_tuples(document: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in document.items()}


def table(reports: Sequence[Report]) -> str:
    """The table as Markdown."""
    bands = " | ".join(f"{hz / 1000:g}k" if hz >= 1000 else f"{hz:g}" for hz in OCTAVE_BANDS_HZ)
    lines = [
        "Reverberation times of our simulation by octave band, and by how much they differ from the median of several "
        "simulations by pyroomacoustics, with the scattering of the scene (others), with mirrors only, and where all "
        "is scattered (rough), and from Eyring's formula; and by how much the bundle's field differs from its data. "
        "Each in the band where it is greatest. Brackets: shown, but not judged (see training/trials/reverberation.py, "
        "and of the field training/trials/field_decay.py).",
        "",
        f"| scene | minutes | {bands} | others | mirrors | rough | Eyring | field | |",
        f"| --- | --- |{' --- |' * (len(OCTAVE_BANDS_HZ) + 6)}",
    ]
    for report in reports:
        cells = [report.scene, f"{sum(report.minutes.values()):.1f}"]
        if report.comparison is None or report.field is None:
            cells += [""] * (len(OCTAVE_BANDS_HZ) + 5)
        else:
            of = report.comparison
            cells += [f"{value:.2f}" for value in of.ours_s]
            cells += [
                _percent(of.from_others, judged=of.judges_others),
                _percent(of.from_mirrors, judged=True),
                _percent(of.from_rough, judged=True),
                _percent(of.from_eyring, judged=of.is_diffuse),
                _of_field(report.field),
            ]
        cells.append("; ".join(report.faults()) or "ok")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _percent(shares: npt.ArrayLike, *, judged: bool) -> str:
    worst = f"{100 * worst_of(shares):.1f} %"
    return worst if judged else f"({worst})"


def _of_field(field: FieldDecay) -> str:
    """The worst judged band, and another band if that differs more."""
    judged, others = (field.differences[which] for which in (field.is_judged, ~field.is_judged))
    shown = [_percent(judged, judged=True)] if field.is_judged.any() else []
    if not shown or worst_of(others) > worst_of(judged):
        shown.append(_percent(others, judged=False))
    return " ".join(shown)


def main(arguments: Sequence[str]) -> int:
    folder, *chosen = map(Path, arguments)
    scenes = chosen or sorted(OWN.glob("*.toml"))
    reports = []
    for number, scene in enumerate(scenes, 1):
        sys.stdout.write(f"{scene.stem} ({number} of {len(scenes)})\n")
        sys.stdout.flush()
        reports.append(make(scene, folder / scene.stem))
    text = table(reports)
    folder.with_suffix(".md").write_text(text)
    sys.stdout.write(text)
    return 0 if all(report.passed for report in reports) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
