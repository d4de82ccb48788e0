"""The best set of couples in which no member serves twice: a matching of least cost, exact for every crowd met."""

from __future__ import annotations

from collections import defaultdict

Edge = tuple[int, int, float, int]
"""Two members, what taking them costs, and the couple's index."""
MOST_STATES = 20_000
"""States remembered for one cluster; a larger tangle is matched greedily, cheapest first."""


def best_matching(a: list[int], b: list[int], cost: list[float], worth: float) -> list[int]:
    """Indices, ascending, of the couples (a[k], b[k]) whose costs, less ``worth`` each, sum to the least.

    No member serves twice; a couple that costs ``worth`` or more is never taken.
    """
    edges = [(x, y, c - worth, k) for k, (x, y, c) in enumerate(zip(a, b, cost, strict=True)) if c < worth]
    return sorted(k for cluster in _clusters(edges) for k in _matched(cluster))


def _clusters(edges: list[Edge]) -> list[list[Edge]]:
    """Groups of edges that share members, directly or through others."""
    parent: dict[int, int] = {}

    def root(x: int) -> int:
        while parent.setdefault(x, x) != x:
            parent[x] = x = parent[parent[x]]
        return x

    for x, y, _, _ in edges:
        parent[root(x)] = root(y)
    groups: dict[int, list[Edge]] = defaultdict(list)
    for edge in edges:
        groups[root(edge[0])].append(edge)
    return list(groups.values())


def _matched(edges: list[Edge]) -> list[int]:
    """The best matching of one cluster's edges (a, b, cost, index)."""
    if len(edges) == 1:
        return [edges[0][3]]
    order = {x: n for n, x in enumerate(sorted({x for a, b, _, _ in edges for x in (a, b)}))}
    options: dict[int, list[tuple[int, float, int]]] = defaultdict(list)
    for a, b, cost, index in edges:
        low, high = sorted((order[a], order[b]))
        options[low].append((high, cost, index))
    exact = _exact(options, len(order))
    return _greedy(edges) if exact is None else exact


def _exact(options: dict[int, list[tuple[int, float, int]]], count: int) -> list[int] | None:
    """Member by member: states are the later members already used, each with its cheapest way there."""
    states: dict[int, tuple[float, tuple[int, ...]]] = {0: (0.0, ())}
    for x in range(count):
        following: dict[int, tuple[float, tuple[int, ...]]] = {}
        for used, (cost, picked) in states.items():
            moves = [(used & ~(1 << x), cost, picked)]
            if not used >> x & 1:
                moves += [(used | 1 << y, cost + c, (*picked, k)) for y, c, k in options[x] if not used >> y & 1]
            for state, total, way in moves:
                if state not in following or total < following[state][0]:
                    following[state] = (total, way)
        if len(following) > MOST_STATES:
            return None
        states = following
    return list(min(states.values())[1])


def _greedy(edges: list[Edge]) -> list[int]:
    """Cheapest couple first."""
    taken: set[int] = set()
    picked = []
    for a, b, _, index in sorted(edges, key=lambda e: e[2]):
        if a not in taken and b not in taken:
            taken |= {a, b}
            picked.append(index)
    return picked
