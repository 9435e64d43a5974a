"""Keys of a cloud: made once, rotated without a gap, retired at once; private keys stay in the secret."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from rse_pf.auth.tokens import SigningKey, verify_token
from rse_pf.aws.account import Account
from rse_pf.aws.clients import make_client
from rse_pf.aws.storage.key_store import KEYS_NAME, KeyRing, KeyStore, open_key_store, spread_s
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import ConfigurationError, Unauthorized

SETTINGS = PlatformSettings()
AUTH = SETTINGS.auth
BORN_S = 1_800_000_000.0


def key(name: str) -> SigningKey:
    return SigningKey.from_seed(name.encode() * 32, name)


def ring(*names: str) -> KeyRing:
    return KeyRing(keys=tuple((key(name), BORN_S) for name in names))


def is_trusted(token: str, by: KeyRing, now: float) -> bool:
    try:
        verify_token(token, keys=by.key_set(), now=now, settings=AUTH)
    except Unauthorized:
        return False
    return True


@pytest.fixture
def store(region: str) -> KeyStore:
    """The secret and the bucket, as CloudFormation leaves them: the secret holds random letters."""
    account = Account(region)
    account.client("s3").create_bucket(
        Bucket="artifacts", CreateBucketConfiguration={"LocationConstraint": region}
    )
    account.client("secretsmanager").create_secret(Name="signing-key", SecretString='x"{R3:)k')
    return KeyStore(account, secret="signing-key", bucket="artifacts")


def test_a_written_ring_is_read_back_and_its_public_keys_are_in_the_bucket(
    region: str, store: KeyStore
) -> None:
    store.write(ring("a", "b"))

    assert store.ring().to_json() == ring("a", "b").to_json()
    published = make_client("s3", region).get_object(Bucket="artifacts", Key=KEYS_NAME)["Body"].read()
    rows = json.loads(published)["keys"]
    assert [row["kid"] for row in rows] == ["a", "b"]
    assert all(set(row) == {"kty", "crv", "kid", "x"} for row in rows), "a private key is published"


@pytest.mark.parametrize("text", ['{"keys": [{"jwk": {}, "from_s": 1}]}', '{"keys": [7]}', '{"keys": 7}'])
def test_broken_keys_are_an_error_and_not_a_missing_ring(text: str) -> None:
    with pytest.raises(ConfigurationError):
        KeyRing.from_json(text)


def test_a_new_key_signs_only_when_every_server_knows_it() -> None:
    rotated = ring("a").rotated(key("b"), now=BORN_S + 10, settings=SETTINGS)

    knows_s = BORN_S + 10 + spread_s(SETTINGS)
    assert rotated.signer(knows_s - 1).key_id == "a"
    assert rotated.signer(knows_s).key_id == "b"


def test_tokens_are_valid_throughout_a_rotation() -> None:
    before = ring("a")
    rotated = before.rotated(key("b"), now=BORN_S, settings=SETTINGS)
    for at_s in range(0, 2 * AUTH.token_ttl_s, 30):
        now = BORN_S + at_s
        token = rotated.signer(now).issue("robot-1", now=now, token_id="t", settings=AUTH)
        known = before if at_s < spread_s(SETTINGS) else rotated  # the slowest server

        assert is_trusted(token, known, now), at_s
        assert is_trusted(token, rotated, now + AUTH.token_ttl_s), at_s


def test_the_old_key_stays_until_its_last_token_has_expired() -> None:
    rotated = ring("a").rotated(key("b"), now=BORN_S, settings=SETTINGS)
    over_s = BORN_S + spread_s(SETTINGS) + AUTH.token_ttl_s + AUTH.leeway_s

    with pytest.raises(ConfigurationError, match="1 s more"):
        rotated.rotated(key("c"), now=over_s - 1, settings=SETTINGS)
    assert [one.key_id for one, _ in rotated.rotated(key("c"), now=over_s, settings=SETTINGS).keys] == [
        "b",
        "c",
    ]


def test_a_retired_key_is_no_longer_trusted_and_the_other_signs_at_once() -> None:
    rotated = ring("a").rotated(key("b"), now=BORN_S, settings=SETTINGS)
    stolen = key("a").issue("robot-1", now=BORN_S, token_id="t", settings=AUTH)

    retired = rotated.retired(now=BORN_S + 1, force=True)

    assert not is_trusted(stolen, retired, BORN_S + 1)
    assert retired.signer(BORN_S + 1).key_id == "b"


def test_a_key_cannot_be_retired_while_servers_may_not_know_the_next() -> None:
    rotated = ring("a").rotated(key("b"), now=BORN_S, settings=SETTINGS)

    with pytest.raises(ConfigurationError) as told:
        rotated.retired(now=BORN_S + spread_s(SETTINGS) - 5)

    assert told.value.message == "servers may lack key b and refuse robots for 5 s more"
    assert "--force" in told.value.hint
    assert rotated.retired(now=BORN_S + spread_s(SETTINGS)).keys[0][0].key_id == "b"


class Formation:
    """A CloudFormation with one stack, or none."""

    def __init__(self, *rows: tuple[str, str, str]) -> None:
        names = ("LogicalResourceId", "ResourceType", "PhysicalResourceId")
        self.rows = [dict(zip(names, row, strict=True)) for row in rows]

    def can_paginate(self, method: str) -> bool:
        return False

    def list_stack_resources(self, *, StackName: str) -> dict[str, Any]:
        assert StackName == "RsePf-Data"
        return {"StackResourceSummaries": self.rows}


def beside(region: str, formation: Formation) -> Account:
    make: Callable[[str, str], Any] = make_client
    return Account(region, lambda name, at: formation if name == "cloudformation" else make(name, at))


def test_secret_and_bucket_are_found_through_the_stack(region: str, store: KeyStore) -> None:
    account = beside(
        region,
        Formation(
            ("SigningKey8FF1", "AWS::SecretsManager::Secret", "signing-key"),
            ("ArtifactsPolicyA1", "AWS::S3::BucketPolicy", "wrong"),
            ("Artifacts1F2E", "AWS::S3::Bucket", "artifacts"),
            ("Maps77", "AWS::S3::Bucket", "wrong"),
        ),
    )

    open_key_store(account, ResourceNames()).write(ring("a"))

    assert store.ring().to_json() == ring("a").to_json()


def test_the_only_key_cannot_be_retired() -> None:
    with pytest.raises(ConfigurationError):
        ring("a").retired(now=BORN_S)
