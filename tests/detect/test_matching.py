"""The best set of couples against all sets that there are."""

from __future__ import annotations

from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector.detect.matching import best_matching

WORTH = 9.0
couples = st.lists(
    st.tuples(st.integers(0, 7), st.integers(0, 7), st.floats(0, 14)).filter(lambda c: c[0] != c[1]),
    max_size=9,
    unique_by=lambda c: c[:2],
)
"""Ordered couples of eight members; some both ways, some not worth taking."""
Couples = list[tuple[int, int, float]]


def matched(edges: Couples) -> list[int]:
    return best_matching([a for a, _, _ in edges], [b for _, b, _ in edges], [c for _, _, c in edges], WORTH)


def total(edges: Couples, chosen: tuple[int, ...] | list[int]) -> float:
    return sum(edges[k][2] - WORTH for k in chosen)


def disjoint(edges: Couples, chosen: tuple[int, ...] | list[int]) -> bool:
    members = [member for k in chosen for member in edges[k][:2]]
    return len(members) == len(set(members))


@given(edges=couples)
def test_no_other_set_costs_less(edges: Couples) -> None:
    chosen = matched(edges)
    sets = (s for n in range(len(edges) + 1) for s in combinations(range(len(edges)), n) if disjoint(edges, s))
    assert disjoint(edges, chosen)
    assert total(edges, chosen) == pytest.approx(min(total(edges, s) for s in sets), abs=1e-9)
    assert chosen == sorted(chosen)
    assert all(edges[k][2] < WORTH for k in chosen)


def test_two_cheaper_couples_beat_the_cheapest() -> None:
    assert matched([(0, 1, 3.0), (1, 2, 0.0), (2, 3, 3.0)]) == [0, 2]


@pytest.mark.timeout(20)
def test_a_tangle_beyond_exact_search_still_ends_in_a_matching() -> None:
    """Every two of 40 members may belong together."""
    edges = [(a, b, (a * 7 + b * 13) % 9 * 0.9) for a in range(40) for b in range(40) if a != b]
    chosen = matched(edges)
    assert disjoint(edges, chosen)
    assert len(chosen) == 20


@pytest.mark.timeout(20)
@pytest.mark.parametrize("reach", [1, 2, 3])
def test_a_long_chain_is_solved_exactly(reach: int) -> None:
    """200 members on a line, each with the next few; only every other neighbour is cheap."""
    edges = [
        (a, a + d, 0.0 if a % 2 == 0 and d == 1 else 4.0)
        for a in range(200)
        for d in range(1, reach + 1)
        if a + d < 200
    ]
    chosen = matched(edges)
    assert [edges[k][:2] for k in chosen] == [(a, a + 1) for a in range(0, 200, 2)]


def test_nothing_to_match() -> None:
    assert matched([]) == []
    assert matched([(0, 1, WORTH)]) == []
