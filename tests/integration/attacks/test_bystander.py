"""The bystander notices what an attack does to it, and nothing where there is none."""

import os
import signal
import sys
import time

import pytest

bystander = sys.modules["bystander"]


def test_a_spell_counts_late_and_missing_blocks_and_the_slowest_answer():
    blocks = [(0.1 * number, int(number == 12), 3 * (number == 15)) for number in range(30)]
    record = bystander.Record(blocks, [(0.5, 9.0), (1.0, 0.004), (1.4, 0.030), (2.5, 9.0)])
    spell = record.spell(0.95, 2.0)
    assert (spell.blocks, spell.late) == (10 + 3, 1 + 3)  # from the tenth to the nineteenth
    assert (spell.livez_answers, spell.livez_worst_ms) == (2, pytest.approx(30.0))


def test_playback_waits_for_a_block_once():
    """256 samples in 10 ms: the third block comes 55 ms after its time, of which 20 ms are tolerated."""
    playback = bystander._Playback(256, 0.010)
    arrivals_s = [0.0, 0.01, 0.02 + 0.055, 0.085, 0.095]
    assert [playback.silence(256 * number, at_s) for number, at_s in enumerate(arrivals_s)] == [0, 0, 4, 0, 0]
    assert playback.silence(256 * 7, 0.12) == 2  # two blocks were left out


def test_silence_is_harm():
    record = bystander.Record([(0.1, 0, 0)], [(0.1, 0.001)])
    calm, silent = record.spell(0.0, 1.0), record.spell(1.0, 2.0)
    assert not bystander.Harm(calm, silent, calm, 0.0).is_none
    assert bystander.Harm(calm, calm, calm, 0.0).is_none


@pytest.mark.parametrize(("calm_at", "tries"), [(0, 1), (2, 3), (3, 3)])
def test_what_says_nothing_is_tried_again_and_then_fails(endures, monkeypatch, calm_at, tries):
    """Harm beside other programs is nobody's for sure."""
    record = bystander.Record([(0.1, 0, 0)], [(0.1, 0.001)])
    calm, silent = record.spell(0.0, 1.0), record.spell(1.0, 2.0)
    made = []

    def measure(*_):
        made.append(bystander.Harm(calm, calm if len(made) == calm_at else silent, calm, 1.5))
        return "done", made[-1]

    monkeypatch.setattr(bystander, "beside_bystander", measure)
    if calm_at < tries:
        assert endures(None) == "done"
    else:
        with pytest.raises(pytest.fail.Exception, match=r"inconclusive after 3 tries.*kept 1\.5 processors busy"):
            endures(None)
    assert len(made) == tries


def test_no_attack_harms_nobody(endures):
    assert endures(lambda: time.sleep(2.0)) is None


def test_a_server_that_stands_still_is_noticed(address, server_pid):
    def stop():
        os.kill(server_pid, signal.SIGSTOP)
        try:
            time.sleep(1.0)
        finally:
            os.kill(server_pid, signal.SIGCONT)
        time.sleep(1.0)

    _, harm = bystander.beside_bystander(address, server_pid, stop, rest_s=1.0)
    assert not harm.is_none
    assert harm.during.livez_worst_ms > 700
    assert harm.late_beyond_rest > 0.1
