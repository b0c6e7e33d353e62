"""Large arrays that were let go of wait for the next that is as large."""

import threading

import numpy as np

from server.kernels.array_pool import ArrayPool

MIB = 1024 * 1024


def place(array):
    return array.__array_interface__["data"][0]


def test_what_was_let_go_of_is_given_to_the_next_of_its_size():
    pool = ArrayPool(4 * MIB)
    array = pool.take(MIB)
    where = place(array)
    assert where % 64 == 0
    del array
    assert pool.nbytes == MIB
    smaller, again = pool.take(MIB - 64), pool.take(MIB)
    assert (place(again), pool.nbytes) == (where, 0)
    assert place(smaller) != where


def test_what_is_given_has_the_shape_that_was_asked_for_and_not_that_of_the_last():
    pool = ArrayPool(4 * MIB)
    for shape in ((4, MIB // 16), (MIB // 4,), (2, 2, MIB // 16), (2, 2, MIB // 16)):
        floats = pool.floats(*shape)
        assert (floats.shape, floats.dtype, floats.flags.carray) == (shape, np.float32, True)
        floats.fill(1.5)
        where = place(floats)
        del floats
        octets = pool.take(MIB)
        assert (octets.shape, octets.dtype, place(octets)) == ((MIB,), np.uint8, where)
        assert (octets.view(np.float32) == 1.5).all()
        del octets


def test_an_array_is_not_let_go_of_while_a_view_is_left():
    pool = ArrayPool(4 * MIB)
    view = pool.take(MIB).view(np.float32).reshape(2, -1)[1, ::2]
    assert pool.nbytes == 0
    view.fill(1)
    other = pool.take(MIB)
    other.fill(255)
    assert (view == 1).all()
    del view
    assert pool.nbytes == MIB


def test_no_more_wait_than_may_and_the_oldest_go_first():
    pool = ArrayPool(4 * MIB)
    held = [pool.take(size) for size in (2 * MIB, MIB, MIB, MIB)]
    wanted = place(held[-1])
    while held:
        del held[0]
    assert pool.nbytes == 3 * MIB
    assert place(pool.take(MIB)) == wanted


def test_an_array_that_would_drive_out_the_others_does_not_wait():
    pool = ArrayPool(3 * MIB)
    useful, large = pool.take(MIB), pool.take(2 * MIB)
    del useful, large
    assert pool.nbytes == MIB


def test_small_arrays_do_not_wait():
    pool = ArrayPool(MIB)
    array = pool.take(1000)
    del array
    assert pool.nbytes == 0


def test_threads_never_hold_one_array_at_once():
    """Each writes its own number all over what it took, and looks again."""
    pool, faults = ArrayPool(8 * MIB), []

    def work(number):
        for turn in range(200):
            array = pool.take(MIB // 8 * (1 + turn % 2))
            array[::4096] = number
            if (array[::4096] != number).any():
                faults.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not faults
    assert pool.nbytes <= 8 * MIB
