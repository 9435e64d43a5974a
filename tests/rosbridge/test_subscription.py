"""What waits for subscribers is bounded in number and bytes, for each subscription and for a tenant."""

from __future__ import annotations

import pytest

from rse_pf.extensions.rosbridge import subscription as subscriptions
from rse_pf.extensions.rosbridge.subscription import HeldBytes, Subscription, TopicMessage


def test_what_waits_for_all_subscribers_of_a_tenant_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subscriptions, "MAX_HELD_BYTES", 50_000)
    held, other = HeldBytes(), Subscription("/chat", HeldBytes())
    own = [Subscription("/chat", held) for _ in range(5)]
    for _ in range(40):
        for each in (*own, other):
            each.put(TopicMessage(bytes(1000)))

    assert sum(map(len, own)) <= 50 + len(own)
    assert len(other) == 40
    for each in own:
        each.clear()
    assert held.of_tenant == 0
