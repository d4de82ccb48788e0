"""Who is let in and who gives way: the policy alone, without a socket."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector.publish.plc_access import Networks, gives_way

NOW_S = 100.0


@dataclass(frozen=True)
class Place:
    address: str
    may_write: bool = True
    answered: int = 10
    heard_s: float = NOW_S


def test_networks_know_mapped_and_scoped_addresses() -> None:
    networks = Networks(("192.0.2.0/24", "2001:db8::/32", "fe80::/10"))
    peers = ("192.0.2.7", "::ffff:192.0.2.7", "2001:db8::5", "fe80::1%eth0", "192.0.3.7", "::1", "127.0.0.1")
    assert [peer in networks for peer in peers] == [True, True, True, True, False, False, False]


def test_a_network_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="host bits"):
        Networks(("192.0.2.1/24",))


PLC, OFFICE, PANEL = "10.0.0.1", "10.0.0.2", "10.0.0.3"


def test_a_client_that_reconnects_and_never_closes_costs_itself() -> None:
    leaked = [Place(PLC, answered=1, heard_s=NOW_S - age) for age in range(15)]
    assert gives_way(PLC, True, [*leaked, Place(PANEL)], NOW_S) == leaked[-1]


def test_a_crowd_from_elsewhere_costs_the_crowd() -> None:
    crowd = [Place(OFFICE, answered=5 + n) for n in range(15)]
    assert gives_way(PLC, True, [Place(PANEL, heard_s=0), *crowd], NOW_S) == crowd[0]


def test_one_that_is_at_work_stays_before_one_that_only_connected() -> None:
    at_work, silent = Place(PLC, answered=1000, heard_s=NOW_S - 0.1), Place(PLC, answered=0, heard_s=NOW_S - 0.05)
    assert gives_way(PLC, True, [at_work, silent], NOW_S) is silent


def test_one_that_was_switched_off_goes_before_one_that_is_new() -> None:
    dead, new = Place(PLC, answered=1000, heard_s=NOW_S - 30), Place(PLC, answered=0, heard_s=NOW_S - 1)
    assert gives_way(PLC, True, [dead, new], NOW_S) is dead


def test_who_may_write_displaces_a_reader_and_never_the_other_way_round() -> None:
    readers = [Place(f"10.0.1.{n}", may_write=False) for n in range(4)]
    writers = [Place(f"10.0.0.{n}") for n in range(4)]
    assert gives_way("10.9.9.9", True, readers + writers, NOW_S) in readers
    assert gives_way("10.9.9.9", False, readers + writers, NOW_S) is None
    assert gives_way("10.9.9.9", True, writers, NOW_S) is None
    assert gives_way("10.9.9.9", False, [Place(PLC)] * 8, NOW_S) is None


places = st.builds(
    Place,
    st.sampled_from((PLC, OFFICE, PANEL, "10.0.0.4")),
    st.booleans(),
    st.integers(0, 5),
    st.floats(0, NOW_S, allow_nan=False),
)


@given(st.sampled_from((PLC, OFFICE, "10.0.0.9")), st.booleans(), st.lists(places, min_size=1, max_size=12))
def test_nobody_is_left_with_less_for_one_who_then_has_more(address: str, may_write: bool, held: list[Place]) -> None:
    yielding = gives_way(address, may_write, held, NOW_S)
    count = {a: sum(p.address == a for p in held) for a in (PLC, OFFICE, PANEL, "10.0.0.4", "10.0.0.9")}
    if yielding is None:
        assert not count[address]  # who holds a place can always move it
        return
    if yielding.address != address:
        assert may_write or not yielding.may_write
        assert count[yielding.address] > count[address] + 1 or (may_write and not yielding.may_write)
