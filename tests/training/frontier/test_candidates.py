"""Which levels are worth measuring for a field of directions."""

import pytest

from server.core.errors import BundleError
from server.scene.bundle import write_bundle
from server.scene.manifest import Phase
from tests.directional_flat import write_directional
from training.frontier.candidates import candidates


@pytest.fixture
def bundle(tmp_path):
    return write_directional(tmp_path / "flat", order=2)


def test_directions_are_measured_at_each_order_with_both_tails(bundle, tmp_path):
    levels = candidates(bundle, ["none"])
    assert {(level.order, level.tail) for level in levels if level.bus is None} == {
        (order, tail) for order in (None, 0, 1) for tail in ("stft", "bands")
    }
    assert [level.bus for level in levels if level.bus] == [1, 2, 3]
    assert len({level.name for level in levels}) == len(levels)
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    offered = bundle.manifest.model_copy(update={"levels": tuple(levels)})
    assert write_bundle(tmp_path / "all", offered, files).manifest.levels == tuple(levels)


def test_their_phase_is_frozen_or_found_by_iteration(bundle):
    assert {level.phase.kind for level in candidates(bundle)} == {"frozen", "griffin_lim"}
    assert all(level.phase == Phase() for level in candidates(bundle) if level.tail == "bands")


def test_their_reuse_is_refused_by_name(bundle):
    with pytest.raises(BundleError, match=r"fields\.directional: predicts directions, of which no response is reused"):
        candidates(bundle, reuse_of=["directional"])
