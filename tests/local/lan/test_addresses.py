"""Which addresses --lan takes, and which it detects."""

from __future__ import annotations

import pytest

from rse_pf.errors import UsageError
from rse_pf.local.lan.addresses import check_lan_address


@pytest.mark.parametrize(
    "text", ["status", "127.0.0.1", "::1", "0.0.0.0", "::", "224.0.0.1", "10.1.2.3:8700"]
)
def test_what_no_other_machine_can_connect_to_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="--lan") as caught:
        check_lan_address(text)
    assert "192.168.1.20" in caught.value.hint
