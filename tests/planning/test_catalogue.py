"""The catalogue of effects: one object a module, from which everything else is derived."""

from dataclasses import fields
from pathlib import Path

import pytest

from server.acoustics.audibility import JND_THRESHOLDS
from server.planning import effects
from server.planning.catalogue import CATALOGUE, EVERYTHING, emitter_effects, names_on
from server.planning.effect import Effect, EnergyEffect
from server.planning.plan import RenderingDecision
from server.planning.plan_query import Decided
from server.protocol.server_messages import EffectDecision
from server.responses.effect_flags import ALL_ON, EmitterEffects, SharedEffects
from server.scene.effects import EffectName

EFFECTS = pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda effect: effect.name.value)


def test_each_module_is_an_effect_of_the_catalogue():
    (folder,) = effects.__path__
    assert {path.stem for path in Path(folder).glob("[a-z]*.py")} == {name.value for name in EffectName}
    assert list(CATALOGUE) == list(EffectName)


@EFFECTS
def test_each_says_what_it_is_and_moves_parameters_that_have_a_threshold(effect: Effect):
    assert effect.title
    assert effect.what
    assert effect.without
    assert effect.prediction
    assert set(effect.parameters) <= set(JND_THRESHOLDS)


@EFFECTS
def test_each_switches_a_part_of_the_renderer_of_its_own_or_hands_over_a_gain(effect: Effect):
    others = {other.flag for other in CATALOGUE.values() if other is not effect}
    if effect.flag is None:
        assert isinstance(effect, EnergyEffect)
        assert effect.path_gain is not None
    else:
        switches = SharedEffects if effect.is_shared else EmitterEffects
        assert effect.flag in {field.name for field in fields(switches)}
        assert effect.flag not in others


@EFFECTS
def test_without_it_an_emitter_has_all_the_others(effect: Effect):
    of_emitters = {name for name, each in CATALOGUE.items() if not each.is_shared}
    left = emitter_effects(of_emitters - {effect.name})
    assert names_on(left) == of_emitters - {effect.name}
    assert (left == EVERYTHING) is effect.is_shared


def test_a_renderer_by_itself_does_everything_but_what_is_handed_to_it():
    assert names_on(ALL_ON) == {name for name, each in CATALOGUE.items() if not each.is_shared and each.flag}


def test_decisions_on_the_wire_say_what_a_decision_is():
    decided = {field.name for field in fields(RenderingDecision)}
    assert set(EffectDecision.model_fields) == decided
    assert set(Decided.model_fields) == decided | {"title"}
