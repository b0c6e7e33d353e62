"""Encoding beside the event loop: in order, bounded, and known for what it takes. Threads are the tests' own here."""

import numpy as np
import pytest

from server.api.block_encoding import BlockEncoding
from server.protocol.blocks import AudioBlock
from server.protocol.opus import OpusOptions
from server.protocol.packets import BlockEncoder
from server.protocol.server_messages import EmitterRemoved, ListenerRemoved
from server.streaming.stream import StreamFailed, TimedBlock

SIZE = 256


class Jobs(list):
    """A pool and an event loop whose work is done when the test says so."""

    submit = post = list.append

    def work(self):
        while self:
            self.pop(0)()


@pytest.fixture
def jobs():
    return Jobs()


def encoding(jobs, heard, capacity=100):
    encoder = BlockEncoder(OpusOptions(), channels=2, sample_rate=24_000)
    return BlockEncoding(
        lambda: encoder, jobs, block_s=SIZE / 24_000, capacity=capacity, post=jobs.append, deliver=heard.extend
    )


def timed(number):
    return TimedBlock(AudioBlock(number, number * SIZE, 0, 0, np.zeros((2, SIZE), np.float32)), 0.0)


def test_blocks_and_messages_leave_in_the_order_in_which_they_came(jobs):
    heard = []
    encoded = encoding(jobs, heard)
    sent = [timed(0), EmitterRemoved(id="a"), timed(1), timed(2), EmitterRemoved(id="b"), timed(3)]
    assert encoded.put(sent[:2])
    assert encoded.put(sent[2:3])  # while the first are encoded
    assert encoded.put(sent[3:])
    assert len(jobs) == 1  # one thread at a time for one encoder
    jobs.work()
    assert heard == sent
    packets = [each.packets for each in sent if isinstance(each, TimedBlock)]
    assert [each.is_restart for each in packets] == [True, False, False, False]
    ends = [each.sample_clock + each.frames for each in packets]
    assert [each.sample_clock for each in packets] == [0, *ends[:-1]]


def test_more_than_there_is_room_for_is_not_taken(jobs):
    heard = []
    encoded = encoding(jobs, heard, capacity=3)
    assert encoded.put([timed(0)])
    assert encoded.put([timed(1), timed(2)])
    assert not encoded.put([timed(3), timed(4)])
    jobs.work()
    assert [each.block.sequence for each in heard] == [0, 1, 2]
    assert encoded.put([timed(3)])


def test_it_says_what_it_takes(jobs):
    encoded = encoding(jobs, [])
    assert encoded.load == 0.0
    encoded.put([timed(number) for number in range(40)])
    jobs.work()
    assert 0 < encoded.load < 1


def test_it_takes_as_much_of_the_time_that_passes_whoever_has_the_blocks(jobs):
    """Not all listeners have every block: the window of one who acknowledges nothing is full."""
    loads = []
    for listeners in ([0], [1], [0, 1], [1, 0]):
        encoded = encoding(jobs, [])
        for number in range(40):
            sent = [timed(number) for _ in listeners]
            for listener, each in zip(listeners, sent, strict=True):
                each.block.listener = listener
            encoded.put(sent if number < 10 else sent[:1])
            jobs.work()
        passed_s = 40 * SIZE / 24_000
        loads.append(encoded.load * passed_s / encoded._cpu_s)
    assert loads == pytest.approx([1.0] * 4)


def test_a_stream_that_cannot_be_encoded_has_failed(jobs, monkeypatch, caplog):
    heard = []
    encoded = encoding(jobs, heard)
    monkeypatch.setattr(BlockEncoder, "encode", None)
    encoded.put([timed(0), EmitterRemoved(id="a")])
    jobs.work()
    assert heard == [StreamFailed()]
    assert "could not be encoded" in caplog.text


def test_a_loop_that_is_closed_meanwhile_is_nobodys_fault(jobs):
    def closed(_):
        raise RuntimeError("Event loop is closed")

    encoder = BlockEncoder(OpusOptions(), channels=2, sample_rate=24_000)
    encoded = BlockEncoding(lambda: encoder, jobs, block_s=0.01, capacity=9, post=closed, deliver=print)
    encoded.put([timed(0)])
    jobs.work()


def test_each_listener_has_an_encoder_of_its_own_until_it_leaves(jobs):
    heard, made = [], []

    def new_encoder():
        made.append(BlockEncoder(OpusOptions(), channels=2, sample_rate=24_000))
        return made[-1]

    encoded = BlockEncoding(
        new_encoder, jobs, block_s=SIZE / 24_000, capacity=100, post=jobs.append, deliver=heard.extend
    )

    def of(listener, number):
        block = timed(number)
        block.block.listener = listener
        return block

    sent = [of(0, 0), of(1, 0), of(0, 1), of(1, 1), ListenerRemoved(id="a", index=1), of(0, 2), of(1, 2)]
    encoded.put(sent)
    jobs.work()
    assert heard == sent
    assert len(made) == 3
    restarts = [each.packets.is_restart for each in heard if isinstance(each, TimedBlock)]
    assert restarts == [True, True, False, False, False, True]
