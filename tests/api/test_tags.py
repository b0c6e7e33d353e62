"""One tag, one body: on one server over time, and on two servers of one scene."""

import pytest
from starlette.testclient import TestClient

from server.api.app import create_app
from server.api.settings import Settings
from server.field.fields_by_level import FieldsByLevel
from server.planning.cost import Cost
from server.scene.effects import EffectName
from tests.api.test_routes import wait_until_ready

PLAN = "/v1/scenes/flat/plan"


@pytest.fixture
def server(bundle, hrtfs, monkeypatch):
    """Starts one that has measured that every effect costs so much."""
    held = []

    def start(cost_us):
        monkeypatch.setattr(
            "server.api.app.measure_costs", lambda *_, **__: {name: Cost(cost_us, 1000) for name in EffectName}
        )
        monkeypatch.setattr("server.api.app._COSTS_AFTER_S", 0.0)
        client = TestClient(create_app(Settings(), scenes={"flat": FieldsByLevel.load(bundle)}, hrtfs=hrtfs))
        held.append(client)
        client.__enter__()
        wait_until_ready(client)
        for _ in range(1_000):
            answer = client.get(PLAN)
            if any(decision["cost_us"] == cost_us for decision in answer.json()["decisions"]):
                return client
        raise AssertionError("costs were never measured")

    yield start
    for client in held:
        client.__exit__(None, None, None)


def test_plans_of_servers_that_measured_otherwise_have_tags_of_their_own(server):
    slow, quick = (server(cost_us).get(PLAN) for cost_us in (70.0, 7.0))
    assert slow.content != quick.content
    assert slow.headers["etag"] != quick.headers["etag"]


def test_a_plan_that_a_client_has_is_not_sent_again(server):
    client = server(7.0)
    tag = client.get(PLAN).headers["etag"]
    assert client.get(PLAN, headers={"If-None-Match": tag}).status_code == 304
    assert client.get(PLAN, headers={"If-None-Match": '"other"'}).headers["etag"] == tag
    assert client.get(PLAN).headers["cache-control"] == "no-cache"
