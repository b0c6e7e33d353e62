"""Large arrays that were let go of wait for the next that is as large."""

import threading

import numpy as np

from server.kernels.array_pool import ArrayPool

MIB = 1024 * 1024


def place(array):
    return array.__array_interface__["data"][0]


def test_what_was_let_go_of_is_given_to_the_next_of_its_size():
    spares = ArrayPool(4 * MIB)
    array = spares.take(MIB)
    where = place(array)
    assert where % 64 == 0
    del array
    assert spares.nbytes == MIB
    smaller, again = spares.take(MIB - 64), spares.take(MIB)
    assert (place(again), spares.nbytes) == (where, 0)
    assert place(smaller) != where


def test_an_array_is_not_let_go_of_while_a_view_is_left():
    spares = ArrayPool(4 * MIB)
    view = spares.take(MIB).view(np.float32).reshape(2, -1)[1, ::2]
    assert spares.nbytes == 0
    view.fill(1)
    other = spares.take(MIB)
    other.fill(255)
    assert (view == 1).all()
    del view
    assert spares.nbytes == MIB


def test_no_more_wait_than_may_and_the_oldest_go_first():
    spares = ArrayPool(4 * MIB)
    held = [spares.take(size) for size in (2 * MIB, MIB, MIB, MIB)]
    wanted = place(held[-1])
    while held:
        del held[0]
    assert spares.nbytes == 3 * MIB
    assert place(spares.take(MIB)) == wanted


def test_an_array_that_would_drive_out_the_others_does_not_wait():
    spares = ArrayPool(3 * MIB)
    useful, large = spares.take(MIB), spares.take(2 * MIB)
    del useful, large
    assert spares.nbytes == MIB


def test_small_arrays_do_not_wait():
    spares = ArrayPool(MIB)
    array = spares.take(1000)
    del array
    assert spares.nbytes == 0


def test_threads_never_hold_one_array_at_once():
    """Each writes its own number all over what it took, and looks again."""
    spares, faults = ArrayPool(8 * MIB), []

    def work(number):
        for turn in range(200):
            array = spares.take(MIB // 8 * (1 + turn % 2))
            array[::4096] = number
            if (array[::4096] != number).any():
                faults.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not faults
    assert spares.nbytes <= 8 * MIB
