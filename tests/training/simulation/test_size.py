"""How much a scene file asks for is told from its numbers alone; too much is refused by what makes it so."""

from time import perf_counter

import pytest

from training.data.dataset import Dataset
from training.data.scene_file import SceneFile, SceneFileError
from training.simulation.planner import planner_of
from training.simulation.size import SimulationSize


@pytest.fixture(scope="module")
def box(tiny_scene):
    return SceneFile.read(tiny_scene)


def with_(scene, **changes):
    for name, value in changes.items():
        part, field = name.split("__")
        scene = scene.model_copy(update={part: getattr(scene, part).model_copy(update={field: value})})
    return scene


def square(side_m):
    return ((0.0, 0.0), (side_m, 0.0), (side_m, side_m), (0.0, side_m))


def test_a_small_room_is_reasonable_and_counted_as_it_is(box):
    size = SimulationSize(box)
    size.require_reasonable()
    assert size.probes == len(box.probe_positions(0)) == 6
    assert size.pairs == 30


def test_with_fewer_listeners_there_are_fewer_pairs_and_less_of_everything(box):
    many = with_(box, probes__spacing_m=0.15)
    few = with_(many, simulation__listeners=10)
    whole, part = SimulationSize(many), SimulationSize(few)
    assert part.probes == whole.probes > 100
    assert part.pairs == 10 * part.probes
    for name in ("dataset_gb", "memory_gb", "core_minutes"):
        assert getattr(part, name) < getattr(whole, name)
    assert f"{part.pairs:,} pairs" in str(part)
    assert SimulationSize(with_(box, simulation__listeners=10)).pairs == SimulationSize(box).pairs


def test_data_are_as_much_as_a_file_of_them_holds(dataset: Dataset):
    """Of energies that are each pair's own for the whole duration, uncompressed."""
    size = SimulationSize(dataset.scene)
    held_out = int(dataset.held_out.sum())
    energy = dataset.scene.simulation.arrival_directions * 7 * round(dataset.samples / dataset.sample_rate / 0.004) * 2
    exact = (size.pairs + held_out) * energy
    assert size.dataset_gb * 1e9 == pytest.approx(exact, rel=0.1)


@pytest.mark.parametrize(
    ("changes", "field", "says"),
    [
        ({"probes__spacing_m": 0.001}, "probes.spacing_m", r"12,000,000 probes, 143,999,988,000,000 pairs"),
        ({"probes__spacing_m": 0.05}, "probes.spacing_m", "at most 2,000 probes"),
        (
            {"geometry__corners": square(800.0), "probes__spacing_m": 8.0},
            "probes.spacing_m",
            "a room of 800 m may be in centimetres",
        ),
        ({"simulation__image_order": 6, "probes__spacing_m": 0.3}, None, ""),
        (
            {"simulation__duration_s": 80.0, "simulation__arrival_directions": 1000, "simulation__yaws": 360},
            "simulation.",
            "duration_s is in seconds, not milliseconds",
        ),
        ({"simulation__duration_s": 40.0, "probes__spacing_m": 0.1}, "simulation.duration_s", "GB"),
        (
            {"simulation__rays": 2_000_000, "probes__spacing_m": 0.15, "simulation__duration_s": 5.0}
            | {"simulation__yaws": 1},
            "simulation.rays",
            "days",
        ),
    ],
)
def test_what_is_too_much_is_refused_at_once_with_its_size(box, changes, field, says):
    scene = with_(box, **changes)
    if field is None:
        SimulationSize(scene).require_reasonable()
        return
    began = perf_counter()
    with pytest.raises(SceneFileError, match=f"{field}.*{says}") as refusal:
        planner_of(scene, 0)
    assert perf_counter() - began < 1
    assert all(unit in str(refusal.value) for unit in ("probes", "pairs", "GB", "of one core"))


def test_many_walls_allow_few_orders(box):
    """Of twenty notches along one side."""
    teeth = [(float(x), y) for x in range(40, 0, -1) for y in ((9.0, 8.0) if x % 2 else (8.0, 9.0))]
    notched = with_(box, geometry__corners=((0.0, 0.0), (41.0, 0.0), *teeth, (0.0, 9.0)), simulation__image_order=6)
    with pytest.raises(SceneFileError, match=r"simulation.image_order.* walls"):
        SimulationSize(notched).require_reasonable()
    SimulationSize(with_(notched, simulation__image_order=3)).require_reasonable()
