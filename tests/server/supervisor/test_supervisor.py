"""What `serve` refuses before it starts anything."""

from __future__ import annotations

import pytest

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.server.supervisor import serve

KEYS = SigningKey.from_seed(b"d" * 32, "k1").key_set()


@pytest.mark.parametrize(
    ("groups", "keys", "echo", "word"),
    [
        ({}, None, False, "no keys"),
        ({"auth": {"required": False}, "serving": {"host": "0.0.0.0"}}, None, False, "auth.required"),
        ({"auth": {"required": False}, "serving": {"host": "example.org"}}, KEYS, False, "auth.required"),
        ({"serving": {"host": "0.0.0.0"}}, KEYS, True, "conformance echo"),
        ({"serving": {"host": "::"}}, None, True, "conformance echo"),
    ],
)
def test_a_server_without_authentication_on_a_public_address_is_refused_with_a_hint(groups, keys, echo, word):
    settings = PlatformSettings.from_dict(groups)

    with pytest.raises(ConfigurationError, match=word) as caught:
        serve(settings, keys=keys, server_id="s", conformance_echo=echo)

    assert caught.value.hint
