"""Workers agree on the epoch without the main process saying a word."""

from __future__ import annotations

import multiprocessing

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.loading.cursor import Cursor, Identity, Position


def test_iterations_without_workers_count_the_epochs():
    cursor = Cursor()
    assert [cursor.claim() for _ in range(3)] == [(0, 0), (1, 0), (2, 0)]
    cursor.set(Position(7, 5), resumed=True)
    assert cursor.peek() == ((7, 5), True)
    assert [cursor.claim() for _ in range(2)] == [(7, 5), (8, 0)]
    assert cursor.peek() == ((9, 0), False)


def test_workers_of_an_iteration_share_its_epoch_in_any_order_of_arrival():
    cursor = Cursor()
    first, second = Identity(11, 0, 0), Identity(12, 0, 0)
    assert cursor.claim(1, first) == (0, 0)
    assert cursor.claim(0, second) == (1, 0)  # begun before all workers of the first had come
    assert cursor.claim(0, first) == (0, 0)
    assert cursor.claim(2, first) == (0, 0)
    assert cursor.claim(1, second) == (1, 0)


def test_equal_tokens_are_told_apart_by_who_has_come():
    """A user who seeds torch alike before each epoch makes the DataLoader draw the same token."""
    cursor, same = Cursor(), Identity(11, 0, 0)
    assert [[cursor.claim(worker, same) for worker in (1, 0)] for _ in range(3)] == [
        [(0, 0)] * 2, [(1, 0)] * 2, [(2, 0)] * 2]


def test_equal_tokens_of_other_numbers_of_workers_are_told_apart():
    cursor = Cursor()
    two, four = Identity(11, 0, 0, workers=2), Identity(11, 0, 0, workers=4)
    assert {cursor.claim(worker, two) for worker in range(2)} == {(0, 0)}
    assert {cursor.claim(worker, four) for worker in (2, 3, 0, 1)} == {(1, 0)}  # 2 and 3 come first


def test_a_worker_killed_before_it_came_leaves_no_place_for_the_next_generation():
    cursor = Cursor()
    cursor.claim(0, Identity(11, 0, cursor.generation))  # worker 1 never comes
    cursor.set(Position(4, 0))
    later = Identity(11, 0, cursor.generation)
    assert [cursor.claim(worker, later) for worker in (1, 0)] == [(4, 0), (4, 0)]


def test_many_iterations_and_many_workers_fit():
    cursor = Cursor()
    for epoch in range(100):
        assert {cursor.claim(worker, Identity(epoch, 0, 0)) for worker in range(130)} == {(epoch, 0)}
    with pytest.raises(OcnfError, match="num_workers"):
        cursor.claim(1024, Identity(0, 0, 0))


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_processes_share_the_cursor(method):
    context = multiprocessing.get_context(method)
    cursor, answers = Cursor(), context.SimpleQueue()
    cursor.set(Position(5, 3))
    for token in (1, 2):
        processes = [context.Process(target=_claim, args=(cursor, worker, token, answers))
                     for worker in range(2)]
        for process in processes:
            process.start()
        got = {answers.get() for _ in processes}
        for process in processes:
            process.join()
        assert got == {(5, 3) if token == 1 else (6, 0)}
    assert cursor.peek() == ((7, 0), False)


def _claim(cursor, worker, token, answers):
    answers.put(tuple(cursor.claim(worker, Identity(token, 0, cursor.generation))))
