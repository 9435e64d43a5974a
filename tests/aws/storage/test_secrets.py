"""The signing key's secret, and what its errors do not say."""

from __future__ import annotations

import pytest

from rse_pf.aws.clients import make_client
from rse_pf.aws.storage import read_secret, write_secret
from rse_pf.errors import NotFound


def test_a_secret_is_read_as_it_was_written(region: str) -> None:
    client = make_client("secretsmanager", region)
    client.create_secret(Name="signing-key", SecretString="old")

    write_secret(client, "signing-key", "new")

    assert read_secret(client, "signing-key") == "new"


def test_a_missing_secret_is_not_found_and_does_not_leak(region: str) -> None:
    client = make_client("secretsmanager", region)

    with pytest.raises(NotFound) as told:
        write_secret(client, "nothing", "private half")

    assert "private half" not in told.value.report()
    assert told.value.__cause__ is None
