"""What the actions of a running platform tell: robots, addresses of a LAN, refused pauses."""

from __future__ import annotations

import pytest

from rse_pf.cli.local_platform.lan import chosen_address
from rse_pf.errors import UsageError


def test_a_lan_without_tokens_or_with_a_certificate_from_elsewhere_is_refused() -> None:
    from rse_pf.config import PlatformSettings
    from rse_pf.errors import ConfigurationError
    from rse_pf.local.firewall import check_lan_settings

    check_lan_settings(PlatformSettings())
    for changes, said in (
        ({"auth": {"required": False}}, "auth.required"),
        ({"local": {"certificate": "a", "private_key": "b"}}, "local.certificate"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            check_lan_settings(PlatformSettings().replace(**changes))
    with pytest.raises(UsageError):
        chosen_address("0.0.0.0")
