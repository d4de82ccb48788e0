"""The best set of couples in which no member serves twice: a matching of least cost, exact for every crowd met."""

from __future__ import annotations

from collections import defaultdict
from heapq import nsmallest

Options = dict[int, list[tuple[int, float, int]]]
"""For each member, the couples it may be in: the other member, what taking them costs, and the couple's index."""
Way = tuple[int, "Way"] | None
"""The couples taken so far, latest first."""
MOST_MOVES = 40_000
"""Work that one matching is worth: a tangle too dense for it keeps only the cheapest of its states at each step."""


def best_matching(a: list[int], b: list[int], cost: list[float], worth: float) -> list[int]:
    """Indices, ascending, of the couples (a[k], b[k]) whose costs, less ``worth`` each, sum to the least.

    No member serves twice; a couple that costs ``worth`` or more is never taken.
    """
    options: Options = defaultdict(list)
    count = 0
    for k, (x, y, c) in enumerate(zip(a, b, cost, strict=True)):
        if c < worth:
            options[x].append((y, c - worth, k))
            options[y].append((x, c - worth, k))
            count += 1
    most_states = max(MOST_MOVES // max(count, 1), 1)
    return sorted(k for cluster in _clusters(options) for k in _matched(cluster, options, most_states))


def _clusters(options: Options) -> list[list[int]]:
    """Members that couples join, directly or through others; each cluster from near to far, so that few are open."""
    seen: set[int] = set()
    clusters = []
    for start in sorted(options, key=lambda x: len(options[x])):
        if start not in seen:
            seen.add(start)
            members = [start]
            for x in members:
                for y, _, _ in options[x]:
                    if y not in seen:
                        seen.add(y)
                        members.append(y)
            clusters.append(members)
    return clusters


def _matched(members: list[int], options: Options, most_states: int) -> list[int]:
    """The best matching of one cluster, member by member.

    A state is the set of later members already used, as bits; of each the cheapest way there is kept.
    """
    if len(members) == 2:
        return [min(options[members[0]], key=lambda option: option[1])[2]]
    place = {x: n for n, x in enumerate(members)}
    states: dict[int, tuple[float, Way]] = {0: (0.0, None)}
    for n, x in enumerate(members):
        later = [(1 << place[y], cost, k) for y, cost, k in options[x] if place[y] > n]
        states = _after(states, 1 << n, later)
        if len(states) > most_states:
            states = dict(nsmallest(most_states, states.items(), key=lambda item: item[1][0]))
    _, way = min(states.values(), key=lambda value: value[0])
    chosen = []
    while way is not None:
        k, way = way
        chosen.append(k)
    return chosen


def _after(
    states: dict[int, tuple[float, Way]], member: int, later: list[tuple[int, float, int]]
) -> dict[int, tuple[float, Way]]:
    """The states when a member (its bit) is left alone, or joined with a later one where both are still free."""
    following: dict[int, tuple[float, Way]] = {}
    for used, (cost, way) in states.items():
        moves: list[tuple[int, float, Way]] = [(used & ~member, cost, way)]
        if not used & member:
            moves += [(used | other, cost + c, (k, way)) for other, c, k in later if not used & other]
        for state, total, path in moves:
            if state not in following or total < following[state][0]:
                following[state] = (total, path)
    return following
