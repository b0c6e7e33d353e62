"""Many responses over a real connection."""

import http.client
import io
import json
import time

import numpy as np
import pytest

from server.field.fields_by_level import FieldsByLevel

pytestmark = pytest.mark.untimed

POSES = [{"listener": [1, 2, 1.5], "emitter": [6, 3, 1.5], "yaw_deg": yaw} for yaw in range(250)]


def ask(address, **request):
    connection = http.client.HTTPConnection(address, timeout=20)
    headers = {"Content-Type": "application/json"}
    connection.request("POST", "/v1/scenes/flat/impulse-responses", json.dumps(request), headers)
    return connection, connection.getresponse()


def test_a_long_answer_arrives_whole(served):
    connection, answer = ask(served, poses=POSES)
    arrays = np.load(io.BytesIO(answer.read()))
    connection.close()
    assert len(arrays["responses"]) == len(POSES)
    assert np.ptp(arrays["responses"], axis=0).max() > 0


def test_a_client_that_goes_away_stops_the_work(serving, bundle, hrtfs):
    levels = FieldsByLevel.load(bundle)
    compute, computed = levels.default.impulse_responses, []

    def slowly(*arguments, **options):
        computed.append(time.monotonic())
        time.sleep(0.01)
        return compute(*arguments, **options)

    with serving(levels, hrtfs) as address:
        levels.default.impulse_responses = slowly
        computed.clear()
        connection, answer = ask(address, poses=POSES)
        assert answer.read(1)
        answer.close()
        connection.close()
        time.sleep(0.3)
        stopped_at = len(computed)
        time.sleep(0.2)
        assert len(computed) == stopped_at < len(POSES) / 2
