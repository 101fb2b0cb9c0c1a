"""A step of Warp launches, repeated, where Warp is installed."""

from unittest import mock

import pytest


def test_a_step_allocates_once():
    """Claim: steps reuse the arrays of the first one, which start as requested."""
    wp = pytest.importorskip("warp")

    from csac_jax.sim import warp_graph

    totals = []

    def step() -> None:
        zeros, sevens = wp.zeros(2, dtype=int), wp.full(2, 7, dtype=int)
        other = wp.empty_like(zeros)
        totals.append([*zeros.numpy(), *sevens.numpy()])
        for array in (zeros, sevens, other):
            array.fill_(3)

    with wp.ScopedDevice("cpu"), mock.patch.object(wp, "empty", side_effect=wp.empty) as made:
        run = warp_graph.repeated(step, 4)
        tried = made.call_count
        run()
    assert tried == 2  # for zeros and sevens; nothing is allocated for them again
    assert made.call_count == tried
    assert totals[-5:] == [[0, 0, 7, 7]] * 5
