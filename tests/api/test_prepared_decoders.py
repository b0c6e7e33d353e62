"""Decoders that streams on a bus and pages need are made before they are asked for."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest

from server.api.app import _prepare_decoders
from server.field.fields_by_level import FieldsByLevel
from server.rendering.head_decoder import HeadDecoder
from server.rendering.hrtf import kemar
from server.runtime.priority import DutyCycle
from server.scene.bundle import BUNDLED, Bundle
from tests.directional_flat import write_directional


def prepare(levels, head, duty_cycle):
    heads = SimpleNamespace(names=("other",), filters=lambda _name, _rate: head)
    host = SimpleNamespace(scenes={"scene": levels}, hrtfs=heads)
    thread = threading.Thread(target=_prepare_decoders, args=(host, duty_cycle))
    thread.start()
    thread.join()


@pytest.fixture
def head():
    return replace(kemar(24_000))


@pytest.fixture
def designed(monkeypatch):
    """The orders of decoders that had to be designed."""
    from server.rendering import head_decoder

    orders = []
    design = head_decoder._design

    def counted(filters, order, rest):
        orders.append(order)
        return design(filters, order, rest)

    monkeypatch.setattr(head_decoder, "_design", counted)
    return orders


@pytest.fixture(scope="module")
def levels(tmp_path_factory):
    bundle = write_directional(tmp_path_factory.mktemp("flat") / "flat")
    with_bus = bundle.manifest.levels[0].model_copy(update={"name": "bus", "bus": 2})
    manifest = bundle.manifest.model_copy(update={"levels": (*bundle.manifest.levels, with_bus)})
    return FieldsByLevel.load(replace(bundle, manifest=manifest))


def test_a_stream_finds_decoders_for_the_buses_of_its_scene_and_for_pages(levels, head, designed):
    prepare(levels, head, DutyCycle(0.9))
    assert designed == [1, 2]
    HeadDecoder.of(head, 1)
    HeadDecoder.of(head, 2)
    assert designed == [1, 2]


def test_a_scene_without_a_field_needs_none(head, designed):
    prepare(FieldsByLevel.load(Bundle.load(BUNDLED / "open-field")), head, DutyCycle(0.9))
    assert designed == []


def test_a_server_that_shuts_down_does_not_wait(levels, head, designed):
    over = DutyCycle(0.05, stretch_s=0)
    over.call_off()
    prepare(levels, head, over)
    assert designed == [1]
    HeadDecoder.of(head, 1)
    assert designed == [1, 1]  # the first was not finished
