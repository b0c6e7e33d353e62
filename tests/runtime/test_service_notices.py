"""Notices to systemd, as its socket gets them."""

import os
import socket

import pytest

from server.runtime.service_notices import ServiceNotices


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def systemd(tmp_path):
    """What was received since the last call, and the address."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.setblocking(False)

        def received():
            notices = []
            while True:
                try:
                    notices.append(receiver.recv(4096).decode())
                except BlockingIOError:
                    return notices

        received.address = str(tmp_path / "notify")
        yield received


def test_the_service_is_ready_once_and_lives_while_it_says_so_in_time(systemd):
    clock = Clock()
    notices = ServiceNotices(systemd.address, 10.0, time_s=clock)
    notices.ready()
    notices.ready()
    assert systemd() == ["READY=1"]
    for _ in range(250):  # 25 s
        notices.beat()
        clock.now_s += 0.1
    assert systemd() == ["WATCHDOG=1"] * 3
    notices.stopping()
    assert systemd() == ["STOPPING=1"]


def test_what_systemd_asks_for_is_taken_from_the_environment_and_not_left_to_others(systemd):
    asked = {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "30000000", "WATCHDOG_PID": str(os.getpid())}
    environment = {**asked, "HOME": "/"}
    notices = ServiceNotices.take(environment)
    assert environment == {"HOME": "/"}
    assert notices._period_s == 10.0
    notices.beat()
    assert systemd() == ["WATCHDOG=1"]


@pytest.mark.parametrize(
    "environment", [{}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "-5"}, {"WATCHDOG_USEC": "9", "WATCHDOG_PID": "1"}]
)
def test_where_no_signs_of_life_are_asked_for_none_are_given(systemd, environment):
    notices = ServiceNotices.take({"NOTIFY_SOCKET": systemd.address, **environment})
    notices.beat()
    notices.ready()
    assert systemd() == ["READY=1"]


def test_a_name_that_is_not_in_the_file_system_is_understood():
    name = f"nafir-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(f"\0{name}")
        ServiceNotices.take({"NOTIFY_SOCKET": f"@{name}"}).ready()
        assert receiver.recv(64) == b"READY=1"


def test_nobody_who_listens_holds_up_the_service(tmp_path, systemd):
    for address in (None, str(tmp_path / "nothing is here")):
        notices = ServiceNotices(address, 0.0)
        notices.ready()
        notices.beat()
        notices.stopping()
    notices = ServiceNotices(systemd.address, 0.0)
    for _ in range(2_000):  # more than the queue holds
        notices.beat()
    assert systemd()
