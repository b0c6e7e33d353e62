"""Memory does not grow with connections, however they end."""

import asyncio
import os
import time
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.integration.churn import churn

pytestmark = pytest.mark.attack

SCENE = "apartment"
VISITS, STEP = 1_000, 200
AT_ONCE, EMITTERS, BLOCKS = 16, 4, 12
MOST_GROWTH = 0.05
_SETTLED_S = 30.0


def ask(address, path):
    return urllib.request.urlopen(f"http://{address}{path}", timeout=60)


def open_streams(address):
    with ask(address, "/metrics") as answer:
        families = text_string_to_metric_families(answer.read().decode())
        return sum(sample.value for family in families if family.name == "nafir_streams" for sample in family.samples)


def resident_mb(pid):
    with open(f"/proc/{pid}/statm") as statm:  # noqa: PTH123  not a file
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def wait_until(is_so, within_s):
    until_s = time.monotonic() + within_s
    while not is_so():
        assert time.monotonic() < until_s
        time.sleep(0.2)


def test_memory_is_flat_while_a_thousand_come_and_go(measured, server_pid):
    """A third of them drop the connection. What the first 200 leave is kept for those who come after them."""
    resident = []
    for _ in range(VISITS // STEP):
        asyncio.run(churn(measured, STEP, at_once=AT_ONCE, blocks=BLOCKS, emitters=EMITTERS, scene=SCENE))
        wait_until(lambda: open_streams(measured) == 0, _SETTLED_S)
        time.sleep(1.0)
        resident.append(resident_mb(server_pid))
    first, *others = resident
    assert max(others) < (1 + MOST_GROWTH) * first, resident
