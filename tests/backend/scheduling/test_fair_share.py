"""No tenant can hold all places of a server."""

from __future__ import annotations

import random
from collections import Counter

import pytest

from rse_pf.backend.scheduling.fair_share import CLAIM_S, FairShare


def test_the_tenant_that_holds_most_owes_a_place_if_it_keeps_no_fewer_than_who_asks():
    shares = FairShare(8)

    assert shares.donors("new", {"a": 3, "b": 5}) == ["b", "a"]
    assert shares.donors("b", {"a": 6, "b": 2}) == ["a"]
    assert shares.donors("b", {"a": 4, "b": 3}) == [], "the other way round it would owe one back"
    assert shares.donors("a", {"a": 8}) == []


def test_who_holds_most_gives_up_places_as_their_work_ends_while_another_claims_one():
    shares = FairShare(4)
    assert not shares.gives("a", {"a": 4}, 0.0)
    shares.claim("b", 0.0)

    assert shares.gives("a", {"a": 4}, 0.0)
    assert not shares.gives("a", {"a": 3}, 0.0), "one is free already"
    assert not shares.gives("a", {"a": 4}, CLAIM_S), "a claim ends"


def test_a_place_that_became_free_is_kept_for_who_claimed_it():
    shares = FairShare(4)
    shares.claim("b", 0.0)

    assert not shares.takes("a", {"a": 3}, 1.0)
    assert shares.takes("b", {"a": 3}, 1.0)
    assert shares.takes("a", {"a": 3}, 1.0), "b has taken its place: the claim is over"


def test_a_claim_that_is_not_followed_up_blocks_one_place_for_some_seconds_only():
    shares = FairShare(4)
    shares.claim("b", 0.0)
    shares.claim("b", 0.0)

    assert shares.takes("a", {"a": 2}, 0.0)
    assert shares.takes("a", {"a": 3}, CLAIM_S)


@pytest.mark.parametrize("tenants", [2, 3, 5])
def test_tenants_that_always_want_more_end_up_with_equal_shares(tenants: int):
    shares, held = FairShare(10), Counter({"hog": 10})
    names = ["hog", *(f"tenant-{i}" for i in range(tenants - 1))]
    order = random.Random(tenants)
    for step in range(2000):
        now, name = step * 0.01, order.choice(names)
        if shares.takes(name, held, now):
            held[name] += 1
        else:
            shares.claim(name, now)
        ended = order.choice(names)
        if held[ended] and shares.gives(ended, held, now):
            held[ended] -= 1
        assert sum(held.values()) <= 10

    counts = [held[name] for name in names]
    assert max(counts) - min(counts) <= 1
    assert sum(counts) == 10
