"""What requests for the responses of several emitters are found to take."""

import pytest

from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import write_bundle
from server.scene.manifest import QualityLevel, Reuse
from server.streaming import render_costs
from server.streaming.headroom import LIMITS, RenderCost, StreamKind, expected_cost
from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.quality_steps import Offer
from server.streaming.render_costs import kind_of, measure_rendering

BLOCK_S = 256 / 24_000


@pytest.fixture
def levels(bundle, tmp_path):
    levels = (
        QualityLevel(name="reuses", field="arithmetic", reuse=Reuse(spacing_m=2.0, turn_deg=120)),
        QualityLevel(name="computes", field="arithmetic"),
    )
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    return FieldsByLevel.load(write_bundle(tmp_path, bundle.manifest.model_copy(update={"levels": levels}), files))


@pytest.fixture
def costs(levels, filters, monkeypatch):
    """Of a host where nothing takes time but responses: 2 s for each that is computed whole, 0.5 s for each early part,
    and 8 s for each request."""
    spent_s, compute = [0.0], render_costs.compute_irs

    def compute_slowly(levels, request, renderer):
        spent_s[0] += 8.0 + sum(2.0 if asked.like is None else 0.5 for asked in request.asked)
        return compute(levels, request, renderer)

    monkeypatch.setattr(render_costs, "compute_irs", compute_slowly)
    return measure_rendering(levels, filters, time_s=lambda: spent_s[0])


def test_a_response_is_timed_in_a_request_for_those_of_several_emitters(costs):
    """So it takes its part of what a request takes, and not all of it as one that is asked for alone does."""
    assert costs["computes"].response_s == costs["reuses"].response_s == pytest.approx(3.0)


def test_early_parts_are_timed_where_later_parts_are_kept(costs):
    assert costs["reuses"].early_share == 1.0
    assert 12 / 24 <= costs["computes"].early_share <= 15 / 24


def test_other_blocks_cost_the_same_responses_and_ambisonic_ones_are_not_known(levels, costs):
    longer, ambisonic = (kind_of(levels, costs, block_size=512, order=order).render["computes"] for order in (None, 1))
    assert (longer.response_s, longer.early_share) == (costs["computes"].response_s, costs["computes"].early_share)
    assert ambisonic.response_s is None


def step_costs(render, walk, emitters=16):
    """What streams are expected to cost on each step of a ladder whose responses take 1 ms alone."""
    levels = (
        QualityLevel(name="reuses", field="any", reuse=Reuse(spacing_m=2.0, turn_deg=120)),
        QualityLevel(name="computes", field="any"),
    )
    steps = Offer(levels, {"reuses": 1.0, "computes": 1.0}).steps("auto", block_s=BLOCK_S)
    kind = StreamKind(("scene", 24_000, 256, None), BLOCK_S, dict.fromkeys(walk, render), walk)
    return steps, [
        expected_cost(LIMITS, THRESHOLDS, kind, step, emitters=emitters, is_top=not number)
        for number, step in enumerate(steps)
    ]


def test_newcomers_are_expected_to_cost_what_requests_of_several_emitters_take():
    render = RenderCost(40e-6, 6e-6, 30e-6, response_s=0.2e-3, early_share=0.5)
    _, (top, below, *_) = step_costs(render, {"reuses": 0.1, "computes": 1.0})
    assert top.request_s == pytest.approx(16 * 0.2e-3)
    assert below.request_s == pytest.approx((2 + 14 * 0.5) * 0.2e-3)


def test_where_responses_are_few_fewer_of_those_that_were_kept_are_of_use():
    render = RenderCost(40e-6, 6e-6, 30e-6, response_s=0.5e-3)
    steps, costs = step_costs(render, {"reuses": 0.02, "computes": 1.0})
    kept = [cost for step, cost in zip(steps, costs, strict=True) if step.level == "reuses"]
    assert kept[0].request_s == pytest.approx(16 * 0.5e-3 * 0.02 * LIMITS.poses_hz / THRESHOLDS.least_ir_rate_hz)


def test_emitters_that_share_their_reverberation_are_expected_to_take_less_rendering():
    *_, seldom, least = step_costs(RenderCost(0.0, 10e-6, 0.0), {"reuses": 0.1, "computes": 1.0})[1]
    assert least.rendering == pytest.approx(seldom.rendering * THRESHOLDS.rendering_by_sharing[2])
