"""Who may speak to the PLC server, who may write, and who gives way when all places are taken. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from ipaddress import IPv6Address, ip_address, ip_network
from typing import Protocol, TypeVar

LOOPBACK = ("127.0.0.0/8", "::1/128")

BUSY_S = 2.0
"""A client that was answered within this time is at work; slower ones are rather asked to give way."""


class Holder(Protocol):
    """A connection that holds a place."""

    @property
    def address(self) -> str:
        """The client's address."""
        ...

    @property
    def may_write(self) -> bool:
        """Whether its writes are carried out."""
        ...

    @property
    def answered(self) -> int:
        """Requests answered so far."""
        ...

    @property
    def heard_s(self) -> float:
        """When it was last answered, or else connected; monotonic time."""
        ...


HolderT = TypeVar("HolderT", bound=Holder)


class Networks:
    """A list of addresses and networks. Raises ValueError for what is none."""

    def __init__(self, networks: Iterable[str]) -> None:
        self._networks = tuple(ip_network(network) for network in networks)

    def __contains__(self, peer: object) -> bool:
        address = ip_address(str(peer).partition("%")[0])
        if isinstance(address, IPv6Address) and address.ipv4_mapped:
            address = address.ipv4_mapped
        return any(address in network for network in self._networks)


def gives_way(address: str, may_write: bool, holders: Collection[HolderT], now_s: float) -> HolderT | None:
    """Whose place a newcomer takes when there is none left; None: nobody's, it is refused.

    The address that would then hold most gives one up, the newcomer's own rather than another's: so a client that
    reconnects and never closes, or was switched off, costs itself, and a crowd from elsewhere costs the crowd. Who may
    only read never displaces who may write; who may write displaces a reader even where each address holds one.
    Of an address' connections the one goes that is not at work, asked least and was quiet longest.
    """
    held = Counter(holder.address for holder in holders)
    held[address] += 1
    own = [holder for holder in holders if holder.address == address]
    others = [h for h in holders if h.address != address and (may_write or not h.may_write)]
    most = max((held[holder.address] for holder in others), default=0)
    if own and held[address] >= most:
        candidates = own
    elif most > held[address]:
        candidates = [holder for holder in others if held[holder.address] == most]
    else:
        candidates = [holder for holder in others if may_write and not holder.may_write]
    return min(candidates, key=lambda h: (now_s - h.heard_s < BUSY_S, h.answered, h.heard_s), default=None)
