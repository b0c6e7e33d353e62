import pytest

from server.runtime.pace import CpuBudget, Pace


class Clock:
    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        return self.now_s

    def sleep(self, seconds):
        self.now_s += seconds


def test_threads_share_what_a_budget_allows():
    """Two pieces of work, each of a second, at a tenth of a core."""
    clock = Clock()
    budget = CpuBudget(lambda: 0.1, time_s=clock)
    budget.spend(1.0)
    assert budget.wait_s == 10.0
    budget.spend(1.0)
    assert budget.wait_s == 20.0
    clock.sleep(15.0)
    assert abs(budget.wait_s - 5.0) < 1e-9
    clock.sleep(100.0)
    assert budget.wait_s == 0.0


def test_a_budget_without_end_lets_everything_through():
    budget = CpuBudget(lambda: float("inf"), time_s=Clock())
    budget.spend(100.0)
    assert budget.wait_s == 0.0


def test_work_waits_for_the_budget_as_long_as_it_is_wanted():
    clock, wanted = Clock(), [True]
    budget = CpuBudget(lambda: 0.1, time_s=clock)
    budget.spend(0.5)
    pace = Pace(is_urgent=lambda: False, is_wanted=lambda: wanted[0], budget=budget, sleep=clock.sleep)
    pace.wait()
    assert clock.now_s == pytest.approx(5.0, abs=0.1)
    budget.spend(10.0)
    wanted[0] = False
    pace.wait()
    assert clock.now_s < 5.2


def test_what_work_takes_is_spent():
    clock, cpu = Clock(), Clock()
    budget = CpuBudget(lambda: 0.1, time_s=clock)
    pace = Pace(is_urgent=lambda: False, is_wanted=lambda: True, budget=budget, thread_time_s=cpu, sleep=clock.sleep)
    cpu.sleep(0.3)
    pace.rest()
    assert clock.now_s == pytest.approx(3.0, abs=0.1)
