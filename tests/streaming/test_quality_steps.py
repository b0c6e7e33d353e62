"""Which steps a stream can be given, best first."""

import itertools

import pytest

from server.core.errors import RequestError
from server.protocol.client_messages import AUTO
from server.rendering.convolver import Sharing
from server.scene.manifest import QualityLevel, Reuse
from server.streaming.quality_steps import Offer, QualityStep

BLOCK_S = 256 / 24_000


def offer(**ms_here):
    """Levels in the order given, cheapest first."""
    return Offer(tuple(QualityLevel(name=name, field="any") for name in ms_here), ms_here)


def test_auto_begins_with_the_best_level_whose_response_fits_into_a_block():
    steps = offer(fast=0.5, good=4.0, best=9.0, exact=700.0).steps(AUTO, block_s=BLOCK_S)
    assert steps[0] == QualityStep("best", None, Sharing.NOTHING, 9.0)
    assert [level for level, _ in itertools.groupby(step.level for step in steps)] == ["best", "good", "fast"]
    assert offer(fast=0.5, good=4.0).steps(AUTO, block_s=0.003)[0].level == "fast"
    assert {step.level for step in offer(slow=50.0, slower=60.0).steps(AUTO, block_s=BLOCK_S)} == {"slow"}


def test_down_a_ladder_come_fewer_responses_then_cheaper_levels_then_what_emitters_share():
    levels = (
        QualityLevel(name="shared", field="any", shared_tail=True),
        QualityLevel(name="fast", field="any"),
        QualityLevel(name="good", field="any", ir_rate_hz=20.0),
    )
    steps = Offer(levels, {"shared": 0.3, "fast": 0.4, "good": 4.0}).steps(AUTO, block_s=BLOCK_S)
    assert [(step.level, step.ir_rate_hz, step.sharing) for step in steps] == [
        ("good", 20.0, Sharing.NOTHING),
        ("good", 12.0, Sharing.NOTHING),
        ("good", 5.0, Sharing.NOTHING),
        ("fast", 5.0, Sharing.NOTHING),
        ("shared", 5.0, Sharing.TAIL),
        ("shared", 2.0, Sharing.TAIL),
        ("shared", 5.0, Sharing.REVERBERATION),
    ]
    # At the top every response is computed whole.
    assert [step.late_reach_m > 0 for step in steps] == [False] + 6 * [True]


def test_levels_that_reuse_responses_may_ask_more_often():
    reuse = Reuse(spacing_m=0.5, turn_deg=30)
    levels = (QualityLevel(name="whole", field="any", reuse=reuse), QualityLevel(name="good", field="any"))
    steps = Offer(levels, {"whole": 1.0, "good": 1.1}).steps(AUTO, block_s=BLOCK_S)
    assert [(step.level, step.ir_rate_hz) for step in steps] == [
        ("good", None),
        ("good", 12.0),
        ("good", 5.0),
        ("whole", 12.0),
        ("whole", 2.0),
        ("whole", 5.0),
    ]


def test_auto_leaves_a_bus_to_whoever_asks_for_it():
    levels = (
        QualityLevel(name="fast", field="any"),
        QualityLevel(name="good", field="any"),
        QualityLevel(name="by-bus", field="any", bus=3),
    )
    ms_here = {"fast": 0.3, "good": 2.0, "by-bus": 5.0}
    steps = Offer(levels, ms_here).steps(AUTO, block_s=BLOCK_S)
    assert {step.level for step in steps} == {"good", "fast"}
    assert {step.level for step in Offer(levels, ms_here).steps("by-bus", block_s=BLOCK_S)} == {"by-bus"}
    assert {step.level for step in Offer(levels[2:], ms_here).steps(AUTO, block_s=BLOCK_S)} == {"by-bus"}


def test_a_level_that_was_chosen_is_kept_and_only_its_rate_falls():
    steps = offer(fast=0.5, exact=700.0).steps("exact", block_s=BLOCK_S)
    assert {step.level for step in steps} == {"exact"}
    assert [step.ir_rate_hz for step in steps] == [None, 12.0, 5.0, 2.0, 5.0]
    with pytest.raises(RequestError, match="none of auto, fast"):
        offer(fast=0.5).steps("other", block_s=BLOCK_S)
