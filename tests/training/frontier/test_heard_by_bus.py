"""What the frontier takes for heard by a bus is what the renderer plays."""

import numpy as np
import pytest

from server.acoustics.geometry import Pose, Quaternion
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, render
from server.responses.direct_sound import DirectSound
from server.responses.full_response import FullResponse
from server.scene.manifest import QualityLevel
from tests.directional_flat import write_directional
from training.frontier.cost import measure
from training.frontier.heard_by_bus import HeardByBus, full_response

HERE, THERE = (2.0, 2.5, 1.5), (6.0, 3.0, 1.4)
ON_ITS_SIDE = Quaternion(np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))


@pytest.fixture(scope="module")
def levels(tmp_path_factory):
    bundle = write_directional(tmp_path_factory.mktemp("flat"), order=2, towards=(0.6, 0.64, 0.48))
    ears = AcousticField.load(bundle)
    buses = [QualityLevel(name=f"bus{order}", field="directional", bus=order) for order in (1, 2)]
    return FieldsByLevel([ears, *(AcousticField(bundle, level, ears.graph) for level in buses)])


@pytest.mark.parametrize("name", ["bus1", "bus2"])
@pytest.mark.parametrize("orientation", [Pose.from_yaw(HERE, 1.2).orientation, ON_ITS_SIDE], ids=["yaw", "on its side"])
def test_it_is_what_is_rendered_of_a_click(levels, filters, name, orientation):
    field = levels[name]
    click = np.zeros(256, np.float32)
    click[0] = 0.1
    path = [PathPoint.at(0, Pose(HERE, orientation))]
    direct = DirectSound.of(levels.bundle, filters)
    rendered = render(field, direct, [RenderedEmitter(click, Pose(THERE))], path, length=field.ir_samples)
    (heard,) = HeardByBus(field, filters).impulse_responses([HERE], [THERE], [orientation])
    left = rendered - 0.1 * heard
    # The end of a response that is advanced by the decoder's delay is its last millisecond.
    assert np.abs(left[:, :-64]).max() < 2e-3 * np.abs(rendered).max()


def test_levels_are_heard_as_they_are_rendered(levels):
    assert isinstance(full_response(levels["standard"]), FullResponse)
    assert isinstance(full_response(levels["bus1"]), HeardByBus)
    with pytest.raises(ValueError, match="level standard has no bus"):
        HeardByBus(levels["standard"], None)


def test_a_bus_costs_more_per_block_and_nothing_per_turn(levels):
    times = measure(levels, walk_s=5.0, budget_s=0.1)
    ears, bus = times["standard"], times["bus1"]
    assert np.median(ears.turn) > 0.2 * np.median(ears.miss)
    assert np.median(bus.turn) < 0.05 * np.median(bus.miss)
    assert times["bus2"].block_us > bus.block_us > 0
