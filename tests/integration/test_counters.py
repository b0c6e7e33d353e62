"""What /metrics calls a counter never falls, whoever comes and goes while it is read."""

import asyncio
import threading
import urllib.request
from itertools import pairwise

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.integration.churn import churn

pytestmark = pytest.mark.untimed

PERIOD_S = 0.05
SCRAPERS = 3


def counters(address):
    """By name and labels, histograms bucket by bucket."""
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=10) as answer:
        text = answer.read().decode()
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        if family.type in {"counter", "histogram"}
        for sample in family.samples
    }


@pytest.mark.parametrize("visits", [100, pytest.param(300, marks=pytest.mark.long)])
def test_no_counter_falls_while_streams_come_and_go(served, visits):
    before, is_over = counters(served), threading.Event()
    series = [[before] for _ in range(SCRAPERS)]

    def scrape(scrapes):
        while not is_over.wait(PERIOD_S):
            scrapes.append(counters(served))

    scraping = [threading.Thread(target=scrape, args=[scrapes]) for scrapes in series]
    for thread in scraping:
        thread.start()
    try:
        asyncio.run(churn(served, visits, at_once=8, blocks=4, emitters=1))
    finally:
        is_over.set()
        for thread in scraping:
            thread.join()
    after = counters(served)
    assert after["nafir_blocks_sent_total",] - before["nafir_blocks_sent_total",] >= visits * 4
    assert all(len(scrapes) > visits / 15 for scrapes in series)
    fallen = {
        name: (earlier[name], later[name])
        for scrapes in series
        for earlier, later in pairwise([*scrapes, after])
        for name in earlier
        if later[name] < earlier[name]
    }
    assert fallen == {}
