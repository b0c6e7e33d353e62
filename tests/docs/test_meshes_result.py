"""What was measured of meshes becomes the tables of its page."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.meshes import Measured, Sizes, measure, result_of
from benchmarks.plots import errors_of_meshes, losses_at_a_screen
from benchmarks.record import Host, Result
from training.trials import mesh_laws, plans_as_meshes
from training.trials.mesh_laws import Deviation, Slit
from training.trials.plans_as_meshes import METRICS, SCENES, ByMetric, Compared

HOST = Host(processor="P", instruction_set="AVX2", cores=2)
FEW = Sizes(
    plans=plans_as_meshes.Sizes(emitters=2, listeners=2, takes=2, rays=100),
    laws=mesh_laws.Sizes(rays=400, runs=2, receivers=4, pairs=2, free_paths=1_000, edges=10),
    scenes=(SCENES[0], SCENES[6]),
)


def compared(scene: str, ratio: float, image_order: int = 1) -> Compared:
    drawn = np.linspace(0.9, 1.1, 101)
    of_all = ByMetric(6, error=2.0 * ratio, floor=2.0, shift=0.03, ratios=drawn, shifts=np.array([-0.1, 0.1]))
    return Compared(
        scene, image_order, 9, in_sight=3, rays=100, metrics=dict.fromkeys(METRICS, of_all), plan_s=2.0, mesh_s=3.0
    )


def result(measured: Measured, folder: Path) -> Result:
    """As it is read again from its file."""
    made = result_of(measured, FEW, host=HOST, commit="0123abc", command="c")
    path = folder / "meshes.json"
    path.write_text(made.model_dump_json(), encoding="utf-8")
    return Result.read(path)


def test_scenes_laws_and_slits_stand_with_their_errors(tmp_path: Path) -> None:
    nothing = {"others": [], "decays": [], "reciprocities": [], "screened": [], "screened_places": []}
    tables = result(
        Measured(
            plans=[(compared("a", 1.0), compared("a", 3.0, 2)), (compared("b", 1.5), compared("b", 3.0, 2))],
            deviations=[Deviation("law", "place", "size", 0.01234, 0.02), Deviation("one", "p", "s", -0.5, np.nan)],
            slits=[Slit(0.5, -10.63, -10.51, 0.03)],
            **nothing,
        ),
        tmp_path,
    ).tables
    assert tables["plans"].markdown().splitlines()[2:4] == [
        "| a (3 in sight) | mesh | 2.00 | 2.0 | 2.00 | 2.00 | 2.0000 | 2.000 | 1.50 |",
        "| | floor | 2.00 | 2.0 | 2.00 | 2.00 | 2.0000 | 2.000 | |",
    ]
    assert [str(row[1]) for row in tables["ratios"].rows] == ["1.00 (1.09)", "1.50 (1.09)", "1.25 (1.09)"]
    assert str(tables["images"].rows[0][1]) == "3.00 (1.09)"
    assert tables["shifts"].rows[0][1] == "+0.03 (± 0.10)"
    assert [row[3] for row in tables["laws"].rows] == ["+0.012 (± 0.020)", "-0.500"]
    assert tables["slits"].markdown().splitlines()[2] == "| 0.500 | -10.63 | -10.51 (± 0.03) | +0.12 |"


@pytest.mark.long
def test_everything_is_measured_with_few_rays_and_drawn(tmp_path: Path) -> None:
    said: list[str] = []
    measured = measure(FEW, said.append)
    assert said[0].startswith("plans as meshes: 1 of 2, ")
    found = result(measured, tmp_path)
    assert {name: len(table.rows) for name, table in found.tables.items()} == {
        "plans": 4, "ratios": 3, "shifts": 3, "images": 3, "pyroomacoustics": 6, "eyring": 9, "laws": 12,
        "reciprocity": 3, "slits": 3, "screen": 9, "hidden": 2,
    }  # fmt: skip
    for plot in (errors_of_meshes, losses_at_a_screen):
        assert all(axes.has_data() for axes in plot(found).axes)
    again = measure(FEW, said.append, threads=1)
    assert again.slits == measured.slits
    assert again.deviations == measured.deviations


def test_an_interrupted_run_ends_at_the_step_it_is_at() -> None:
    said: list[str] = []

    def interrupt(text: str) -> None:
        said.append(text)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure(FEW, interrupt, threads=1)
    assert len(said) == 1
