"""What a server prints once it serves."""

import pytest

from server.api import serving
from server.api.process_peers import ProcessPeers


@pytest.mark.parametrize(("cores", "processes"), [(1, None), (3, None), (4, 2), (16, 8), (17, 8)])
def test_where_one_process_leaves_cores_idle_it_says_what_uses_them(monkeypatch, cores, processes):
    monkeypatch.setattr(serving, "usable_cores", lambda: cores)
    first, *hints = serving.announcement(["flat"], "http://here").splitlines()
    assert first == "[bold]Nafir[/] serves flat at [link]http://here[/]"
    told = [] if processes is None else [f"One process fills about two of the {cores} cores: --processes {processes}"]
    assert [hint.removesuffix(" uses them all") for hint in hints] == told


def test_several_processes_say_how_many_they_are(monkeypatch):
    monkeypatch.setattr(serving, "usable_cores", lambda: 16)
    text = serving.announcement(["flat"], "http://here", peers=ProcessPeers(0, (1, 2, 3)))
    assert text == "[bold]Nafir[/] serves flat at [link]http://here[/] with 3 processes"
