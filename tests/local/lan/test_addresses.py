"""Which addresses --lan takes, and which it detects."""

from __future__ import annotations

import ipaddress

import pytest

from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.lan.addresses import check_lan_address, host_names, lan_address


@pytest.mark.parametrize(
    "text", ["status", "127.0.0.1", "::1", "0.0.0.0", "::", "224.0.0.1", "10.1.2.3:8700"]
)
def test_what_no_other_machine_can_connect_to_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="--lan") as caught:
        check_lan_address(text)
    assert "192.168.1.20" in caught.value.hint


def test_an_address_is_written_in_its_usual_form() -> None:
    assert check_lan_address("10.1.2.3") == "10.1.2.3"
    assert check_lan_address("FD00:0:0:0::1") == "fd00::1"


def test_a_detected_address_is_one_of_this_machine_and_no_loopback() -> None:
    try:
        found = lan_address()
    except ConfigurationError:
        pytest.skip("this machine is in no network")

    assert not ipaddress.ip_address(found).is_loopback


def test_the_names_of_this_machine_are_under_local() -> None:
    assert all(name == "localhost" or name.endswith(".local") for name in host_names())
