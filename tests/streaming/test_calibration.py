"""What responses are found to take."""

import time

import numpy as np

from server.acoustics.geometry import Pose
from server.core.bounded_cache import BoundedCache
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.field.node_responses import NODE_CACHE_BYTES
from server.scene.bundle import write_bundle
from server.scene.manifest import QualityLevel, Reuse
from server.streaming.calibration import Listener, calibrate
from tests.directional_flat import write_directional


def two_levels(bundle, folder):
    levels = tuple(QualityLevel(name=f"level{number}", field="arithmetic") for number in range(2))
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    return write_bundle(folder, bundle.manifest.model_copy(update={"levels": levels}), files)


def test_calibration_times_every_level(bundle, tmp_path, filters):
    levels = FieldsByLevel.load(two_levels(bundle, tmp_path))
    costs_ms = calibrate(levels, filters)
    assert list(costs_ms) == list(levels)
    assert np.all(np.array(list(costs_ms.values())) > 0)


def test_a_slow_level_is_asked_no_more_than_it_takes_to_know(bundle, tmp_path, filters, monkeypatch):
    levels = FieldsByLevel.load(two_levels(bundle, tmp_path))
    asked, respond = [], levels["level1"].impulse_responses

    def slowly(*pose, **how):
        asked.append(pose)
        began_s = time.thread_time()  # computing is what counts, not waiting
        while time.thread_time() - began_s < 0.06:
            pass
        return respond(*pose, **how)

    monkeypatch.setattr(levels["level1"], "impulse_responses", slowly)
    assert calibrate(levels, filters)["level1"] >= 60
    assert len(asked) == 2  # the first to warm up


def test_what_is_compiled_the_first_time_is_no_cost_of_the_level(bundle, tmp_path, filters, monkeypatch):
    levels = FieldsByLevel.load(two_levels(bundle, tmp_path))
    asked, respond = [], levels["level0"].impulse_responses

    def slowly_at_first(*pose, **how):
        asked.append(pose)
        began_s = time.thread_time()
        while len(asked) == 1 and time.thread_time() - began_s < 0.2:
            pass
        return respond(*pose, **how)

    monkeypatch.setattr(levels["level0"], "impulse_responses", slowly_at_first)
    assert calibrate(levels, filters)["level0"] < 100
    assert len(asked) > 2


def test_a_response_that_is_kept_is_no_measure_of_one_that_is_not(mirrored_bundle, field, filters):
    """All poses asked for here have one node: kept, the response would cost a hundredth."""
    reuse = Reuse(spacing_m=20, turn_deg=360, first_reflections="node")
    kept = BoundedCache(NODE_CACHE_BYTES)
    level = QualityLevel(name="one", field="arithmetic", reuse=reuse)
    one = AcousticField(mirrored_bundle, level, field.graph, node_cache=kept)
    found_ms = calibrate(FieldsByLevel([one], kept), filters)["one"]
    listener, pose = Listener(one, filters, node_cache=kept, time_s=time.thread_time), Pose((2.0, 2.0, 1.5))
    listener.time_ms(pose)
    assert min(listener.time_ms(pose) for _ in range(20)) < 0.1 * found_ms


def test_a_bus_takes_next_to_nothing_where_the_head_only_turns_and_ears_take_a_response(tmp_path, filters):
    bundle = write_directional(tmp_path)
    ears = AcousticField.load(bundle)
    bus = AcousticField(bundle, QualityLevel(name="by-bus", field="directional", bus=1), ears.graph)
    here, turned = (Pose.from_yaw((2.0, 2.5, 1.5), yaw) for yaw in (0.0, 0.5))
    step = Pose.from_yaw((2.1, 2.5, 1.5), 0.5)
    took_ms = []
    for field in (ears, bus):
        listener = Listener(field, filters, time_s=time.thread_time)
        listener.time_ms(here)
        took_ms.append([listener.time_ms(pose) for pose in (here, turned, step, here)])
    (_, ears_turn, ears_step, _), (_, bus_turn, bus_step, bus_back) = took_ms
    assert ears_turn > 0.2 * ears_step
    assert bus_turn < 0.05 * bus_step
    assert bus_back > 0.2 * bus_step  # another place
