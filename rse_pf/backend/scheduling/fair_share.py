"""Decide which tenant gets one of a limited number of places, so that no tenant can hold all of them.

A tenant may hold every place while nobody else asks.  When all are taken, a tenant that asks for one gets
it from the tenant that holds most, if that one holds at least two more: idle places at once, others when
their work ends.  What a tenant asked for in vain is kept as its claim for `CLAIM_S`, in which a place that
becomes free is not given to a tenant that holds more.  So every tenant gets an equal share of the places in
the end, and a tenant that has its share keeps it.  Time is an argument; nothing here knows what a place is.
"""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["CLAIM_S", "FairShare"]

CLAIM_S = 3.0
"""A robot that was told to try again has done so within this time."""


class FairShare:
    """The claims of tenants to *places*; how many each holds is an argument of every question."""

    def __init__(self, places: int) -> None:
        self._places = places
        self._claims: dict[str, float] = {}

    def takes(self, tenant: str, held: Mapping[str, int], now: float) -> bool:
        """Return whether *tenant* may take a place that is free now; its claim ends if it may.

        Args:
            tenant: Who asks.
            held: Places that each tenant holds.
            now: The time.
        """
        free = self._places - sum(held.values())
        others = [other for other in self._claimants(now) if other != tenant]
        before = sum(_owes(held.get(tenant, 0) + 1, held.get(other, 0)) for other in others)
        if free <= before:
            return False
        self._claims.pop(tenant, None)
        return True

    def claim(self, tenant: str, now: float) -> None:
        """Note that *tenant* asked in vain."""
        self._claims = {other: self._claims[other] for other in self._claimants(now)}
        self._claims[tenant] = now + CLAIM_S

    def donors(self, tenant: str, held: Mapping[str, int]) -> list[str]:
        """Return the tenants that owe *tenant* a place, the one that holds most first."""
        owing = (other for other, count in held.items() if _owes(count, held.get(tenant, 0)))
        return sorted(owing, key=lambda other: (-held[other], other))

    def gives(self, tenant: str, held: Mapping[str, int], now: float) -> bool:
        """Return whether *tenant* gives up a place whose work has ended, because another one claims it."""
        if not self._claims:
            return False
        free = self._places - sum(held.values())
        claims = sum(_owes(held.get(tenant, 0), held.get(other, 0)) for other in self._claimants(now))
        return claims > free

    def _claimants(self, now: float) -> list[str]:
        return [tenant for tenant, until_s in self._claims.items() if until_s > now]


def _owes(donor: int, claimant: int) -> bool:
    """Return whether who holds *donor* places does not hold fewer than the other after giving one up."""
    return donor - 1 >= claimant + 1
