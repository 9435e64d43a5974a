"""Where a server runs."""

from __future__ import annotations

import pytest

from rse_pf.config.placement import is_loopback


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.0.1", "::1", "localhost"])
def test_a_loopback_address_and_the_name_localhost_are_reached_from_this_machine_alone(host: str) -> None:
    assert is_loopback(host)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.1", "localhost.example.com", "example.com", ""])
def test_any_other_address_or_name_can_be_reached_from_elsewhere(host: str) -> None:
    assert not is_loopback(host)
