"""A group of processes at one port, with small processes in place of servers: each says its number to whoever
connects."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from server.api.process_peers import merged
from server.api.processes import HUNG_S, Member, least_loaded, shares_of_cores
from server.core.errors import NafirError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems cannot confine a process to cores")
ROOT = Path(__file__).parents[2]

MEMBER = textwrap.dedent("""
    import json, os, signal, socket, sys, threading, time
    told = json.loads(sys.argv[1])
    folder = told["options"]["folder"]
    number, channel = told["number"], socket.socket(fileno=told["channel"])
    with open(f"{folder}/endings", "a") as file:
        file.write(f"{number} {json.dumps(told['endings'])}\\n")
    with open(f"{folder}/started", "a") as file:
        file.write(f"{number} {os.getpid()} {sorted(os.sched_getaffinity(0))} {told['cores']} {told['url']}\\n")
    if os.path.exists(f"{folder}/refuse"):
        sys.exit(2)
    if os.path.exists(f"{folder}/crash {number}"):
        os.abort()
    def end(*_):
        if os.path.exists(f"{folder}/hang"):
            return
        channel.shutdown(socket.SHUT_RDWR)
        os._exit(0)
    signal.signal(signal.SIGTERM, end)
    def report():
        while True:
            try:
                with open(f"{folder}/load {number}") as file:
                    load = float(file.read() or 0)
            except (OSError, ValueError):
                load = 0.0
            channel.sendall(json.dumps({"is_ready": load >= 0, "load": max(load, 0)}).encode() + b"\\n")
            time.sleep(0.02)
    threading.Thread(target=report, daemon=True).start()
    while True:
        data, descriptors, *_ = socket.recv_fds(channel, 16, 16)
        for each in descriptors:
            with socket.socket(fileno=each) as connection:
                connection.sendall(str(number).encode())
        if not data:
            os._exit(0)
""")

GROUP = textwrap.dedent("""
    import logging, os, socket, sys
    from server.api import processes as module
    from server.api.processes import ProcessGroup
    from server.runtime.service_notices import ServiceNotices
    logging.basicConfig(level=logging.INFO)
    folder, script, processes, hung_s = sys.argv[1:]
    module.HUNG_S = float(hung_s)
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    print(listener.getsockname()[1], flush=True)
    group = ProcessGroup([listener], [[min(os.sched_getaffinity(0))]] * int(processes), {"folder": folder},
                         url="here", drain_s=1.0, command=(sys.executable, script),
                         notices=ServiceNotices.take(os.environ))
    sys.exit(group.run())
""")


class Group:
    def __init__(self, folder, process, port):
        self.folder, self.process, self.port = folder, process, port

    def set_load(self, number, load):
        """Below 0 is not ready."""
        new = self.folder / "new"
        new.write_text(str(load))
        new.rename(self.folder / f"load {number}")

    def connect(self):
        """The number of the process that answers."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=10) as connection:
            return int(connection.recv(16) or -1)

    @property
    def started(self):
        """Number and process id of each that was started."""
        try:
            lines = (self.folder / "started").read_text().splitlines()
        except OSError:
            return []
        return [tuple(int(word) for word in line.split()[:2]) for line in lines]

    def wait_for(self, condition):
        until_s = time.monotonic() + 30
        while not condition():
            assert time.monotonic() < until_s
            time.sleep(0.02)


@contextmanager
def running(folder, processes=2, *, hung_s=HUNG_S, environment=None, **loads):
    script = folder / "member.py"
    script.write_text(MEMBER)
    for name, load in loads.items():
        (folder / f"load {name.removeprefix('of_')}").write_text(str(load))
    command = [sys.executable, "-c", GROUP, str(folder), str(script), str(processes), str(hung_s)]
    pipe, variables = subprocess.PIPE, {**os.environ, **(environment or {})}
    with subprocess.Popen(command, cwd=ROOT, env=variables, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            yield Group(folder, process, int(process.stdout.readline()))
        finally:
            process.kill()


def is_there(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


@pytest.fixture
def group(tmp_path):
    with running(tmp_path) as running_group:
        running_group.wait_for(lambda: len(running_group.started) == 2)
        time.sleep(0.2)
        yield running_group


def test_cores_are_split_evenly_and_neighbours_stay_together():
    assert shares_of_cores(range(8), 2) == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert shares_of_cores([0, 2, 4, 6, 7], 3) == [[0], [2, 4], [6, 7]]
    assert shares_of_cores([3], 1) == [[3]]
    with pytest.raises(NafirError, match=r"processes: 3 are more than the 2 cores"):
        shares_of_cores([0, 1], 3)


def member(number, *, load=0.0, ready=True, reported_s=0.0, handed=0):
    return Member(number, None, None, ready, load, handed, reported_s)


def test_a_connection_goes_to_the_least_loaded_that_is_ready_and_has_reported_lately():
    members = [member(0, load=0.5), member(1, load=0.2, handed=3), member(2, ready=False), member(3, load=0.3)]
    assert [each.number for each in least_loaded(members, 1.0)] == [1, 3, 0]
    members[1].handed = 6
    assert [each.number for each in least_loaded(members, 1.0)] == [3, 1, 0]
    assert {each.number for each in least_loaded(members, 60.0)} == {0, 1, 2, 3}


def test_processes_with_equal_loads_take_turns():
    members = [member(number) for number in range(3)]
    turns = []
    for now_s in range(1, 7):
        first, *_ = least_loaded(members, float(now_s))
        first.handed_s = float(now_s)
        turns.append(first.number)
    assert turns == [0, 1, 2, 0, 1, 2]


def test_reports_may_come_in_pieces_and_the_last_one_counts():
    each = member(0, ready=False, handed=5)
    lines = b"".join(json.dumps({"is_ready": True, "load": load}).encode() + b"\n" for load in (0.1, 0.25))
    each.read(lines[:10], 1.0)
    assert (each.is_ready, each.handed) == (False, 5)
    each.read(lines[10:], 2.0)
    assert (each.is_ready, each.load, each.handed, each.reported_s) == (True, 0.25, 0, 2.0)


def report(each, now_s, *, ready=True):
    each.read(json.dumps({"is_ready": ready, "load": 0}).encode() + b"\n", now_s)


def test_a_process_hangs_once_it_has_not_reported_for_long():
    each = member(0)
    report(each, 0.0)
    for _ in range(int(HUNG_S / 0.5)):
        each.wait(0.5)
    assert not each.is_hung
    each.wait(0.5)
    assert each.is_hung
    report(each, HUNG_S + 0.5)
    assert not each.is_hung


def test_a_long_start_and_a_machine_that_was_stopped_are_no_hang():
    starting, working = (member(number, reported_s=-math.inf) for number in range(2))
    report(starting, 0.0, ready=False)
    report(working, 0.0)
    report(working, 0.0, ready=False)
    for _ in range(10):
        starting.wait(60.0)
        working.wait(600.0)
    assert not starting.is_hung
    assert not working.is_hung
    for _ in range(40):
        working.wait(600.0)
    assert working.is_hung


def test_connections_that_come_together_are_spread_and_later_ones_go_where_there_is_room(group):
    assert sorted(group.connect() for _ in range(2)) == [0, 1]
    group.set_load(0, 0.9)
    time.sleep(0.3)
    assert [group.connect() for _ in range(6)] == [1] * 6
    group.set_load(1, -1)
    time.sleep(0.3)
    assert [group.connect() for _ in range(6)] == [0] * 6


def test_the_others_start_once_the_first_is_ready(tmp_path):
    with running(tmp_path, 3, of_0=-1) as group:
        group.wait_for(lambda: group.started)
        time.sleep(1.2)
        assert [number for number, _ in group.started] == [0]
        assert group.connect() == 0, "which says that it is not ready"
        group.set_load(0, 0)
        group.wait_for(lambda: len(group.started) == 3)
        told = [line.split(maxsplit=2)[2] for line in (tmp_path / "started").read_text().splitlines()]
        assert sorted(number for number, _ in group.started) == [0, 1, 2]
        assert [line.rpartition(" ")[2] for line in told] == ["here", "None", "None"]


def test_a_process_that_dies_is_replaced_and_the_others_go_on(group):
    dead = dict(group.started)[1]
    os.kill(dead, signal.SIGKILL)
    group.wait_for(lambda: len(group.started) == 3)
    assert group.started[-1][0] == 1
    time.sleep(0.3)
    assert sorted(group.connect() for _ in range(2)) == [0, 1]
    group.process.send_signal(signal.SIGTERM)
    assert group.process.wait(10) == 0
    assert "process 1 has ended with code -9 and is replaced" in group.process.stderr.read()


def test_a_process_that_hangs_is_ended_and_replaced_and_the_others_go_on(tmp_path):
    with running(tmp_path, hung_s=4.0) as group:
        group.wait_for(lambda: len(group.started) == 2)
        other, hung = (dict(group.started)[number] for number in range(2))
        group.wait_for(lambda: {group.connect() for _ in range(2)} == {0, 1})  # it has reported
        os.kill(hung, signal.SIGSTOP)
        group.wait_for(lambda: len(group.started) == 3)
        assert group.started[-1][0] == 1
        assert not is_there(hung)
        assert is_there(other)
        group.wait_for(lambda: {group.connect() for _ in range(2)} == {0, 1})
        group.process.send_signal(signal.SIGTERM)
        assert group.process.wait(10) == 0
        told = group.process.stderr.read()
    assert "process 1 has not reported for 4 s and is ended" in told
    assert "process 1 has ended with code -9 and is replaced" in told
    assert (tmp_path / "endings").read_text().splitlines()[-1] == '1 {"hung": 1}'


def test_systemd_is_told_that_the_first_process_serves_and_all_go_on_and_end(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(20)
        asked = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "300000"}
        with running(tmp_path, environment=asked) as group:
            notices = []
            while len(notices) < 2 or notices[-1] != b"WATCHDOG=1":
                notices.append(systemd.recv(64))
                if notices[-1] == b"READY=1":
                    assert group.started
            assert notices.count(b"READY=1") == 1
            group.process.send_signal(signal.SIGTERM)
            while (notice := systemd.recv(64)) != b"STOPPING=1":
                assert notice == b"WATCHDOG=1"
            assert group.process.wait(10) == 0


def test_where_processes_die_again_and_again_the_server_says_so_and_ends(group, tmp_path):
    (tmp_path / "crash 1").touch()
    os.kill(dict(group.started)[1], signal.SIGKILL)
    assert group.process.wait(20) == 1
    assert "as others before: the server ends" in group.process.stderr.read()
    assert [number for number, _ in group.started].count(1) == 3
    assert not any(is_there(pid) for _, pid in group.started)


def test_what_a_user_can_correct_ends_the_server_at_once(tmp_path):
    (tmp_path / "refuse").touch()
    with running(tmp_path) as group:
        assert group.process.wait(20) == 2
        assert len(group.started) == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_all(group, number):
    group.process.send_signal(number)
    assert group.process.wait(10) == 0
    assert not any(is_there(pid) for _, pid in group.started)


def test_a_second_signal_ends_all_at_once(group, tmp_path):
    (tmp_path / "hang").touch()
    group.process.send_signal(signal.SIGTERM)
    time.sleep(0.5)
    assert group.process.poll() is None
    group.process.send_signal(signal.SIGINT)
    assert group.process.wait(10) == 130
    assert not any(is_there(pid) for _, pid in group.started)


def test_processes_that_do_not_end_are_cut_off(group, tmp_path):
    (tmp_path / "hang").touch()
    group.process.send_signal(signal.SIGTERM)
    assert group.process.wait(20) == 1
    assert not any(is_there(pid) for _, pid in group.started)


def test_where_the_first_process_is_killed_the_others_end(group):
    group.process.kill()
    group.wait_for(lambda: not any(is_there(pid) for _, pid in group.started))


def test_metrics_of_all_processes_are_one_text_with_a_label():
    own = b"""# HELP nafir_streams Open streams.
# TYPE nafir_streams gauge
nafir_streams{scene="a"} %d
# HELP nafir_blocks_sent_total Blocks.
# TYPE nafir_blocks_sent_total counter
nafir_blocks_sent_total %d
# HELP nafir_wait_seconds Waits.
# TYPE nafir_wait_seconds histogram
nafir_wait_seconds_bucket{le="0.1"} 1
nafir_wait_seconds_bucket{le="+Inf"} 2
nafir_wait_seconds_count 2
nafir_wait_seconds_sum 0.5
"""
    text = merged({0: own % (3, 100), 1: own % (4, 200), 2: None}).decode()
    families = {family.name: family for family in text_string_to_metric_families(text)}
    assert text.count("# TYPE nafir_streams ") == 1
    values = {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in families.values()
        for sample in family.samples
    }
    assert values["nafir_streams", ("process", "0"), ("scene", "a")] == 3
    assert values["nafir_streams", ("process", "1"), ("scene", "a")] == 4
    assert values["nafir_blocks_sent_total", ("process", "1")] == 200
    assert values["nafir_wait_seconds_bucket", ("le", "+Inf"), ("process", "1")] == 2
    assert families["nafir_wait_seconds"].type == "histogram"
    assert [values["nafir_process_up", ("process", str(number))] for number in range(3)] == [1, 1, 0]
