"""Tokens on the command line: issued with a file that only its owner reads, inspected without secrets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rse_pf.auth.tokens import KeySet
from rse_pf.aws.clients import make_client
from rse_pf.cli.main import main
from rse_pf.local.firewall import ensure_key, key_file, key_set_file
from rse_pf.local.state import settings_file


def issued(capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert main(["token", "issue", "robot-1", *options]) == 0
    (token,) = capsys.readouterr().out.splitlines()
    return token


def inspected(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = main(["token", "inspect", *words])
    return code, json.loads(capsys.readouterr().out)


def test_an_issued_token_is_verified_by_the_platforms_public_keys(
    capsys: pytest.CaptureFixture[str], platform: Path
) -> None:
    code, told = inspected(capsys, issued(capsys, "--ttl", "60"))

    assert code == 0
    assert told["verified"] == "yes"
    assert told["claims"]["sub"] == "robot-1"
    assert told["claims"]["exp"] - told["claims"]["iat"] == 60
    assert 50 <= told["seconds_left"] <= 60


def test_a_token_can_be_signed_and_checked_with_named_files(
    capsys: pytest.CaptureFixture[str], platform: Path
) -> None:
    token = issued(capsys, "--name", "other", "--key", str(key_file(platform)))

    code, told = inspected(capsys, token, "--name", "other", "--keys", str(key_set_file(platform)))
    assert (code, told["verified"]) == (0, "yes")


def test_a_token_follows_the_settings_that_its_platform_was_started_with(
    capsys: pytest.CaptureFixture[str], platform: Path
) -> None:
    chosen = {"context": {"rse-pf": {"auth": {"audience": "my-lab", "token_ttl_s": 30}}}}
    settings_file(platform).write_text(json.dumps(chosen))

    _, told = inspected(capsys, issued(capsys))

    assert told["claims"]["aud"] == "my-lab"
    assert told["verified"] == "yes"
    assert told["claims"]["exp"] - told["claims"]["iat"] == 30


def test_a_longer_ttl_than_the_settings_allow_is_refused(
    capsys: pytest.CaptureFixture[str], platform: Path
) -> None:
    assert main(["token", "issue", "robot-1", "--ttl", "901"]) == 2
    assert "901 s is not within 900 s" in capsys.readouterr().err


def published(s3: Any) -> list[str]:
    text = s3.get_object(Bucket="artifacts", Key="keys.json")["Body"].read().decode()
    KeySet.from_json(text)
    return [row["kid"] for row in json.loads(text)["keys"]]


def test_a_clouds_token_is_good_for_its_servers_and_the_private_half_is_never_printed(
    capsys: pytest.CaptureFixture[str], cloud: Any
) -> None:
    assert main(["token", "init", "--cloud"]) == 0
    (key_id,) = published(cloud)
    secret = make_client("secretsmanager", "ap-northeast-2").get_secret_value(SecretId="signing-key")[
        "SecretString"
    ]
    told = capsys.readouterr()

    assert key_id in told.out
    assert json.loads(secret)["keys"][0]["jwk"]["d"] not in told.out + told.err
    code, said = inspected(capsys, issued(capsys, "--cloud"), "--cloud")
    assert (code, said["verified"], said["header"]["kid"]) == (0, "yes", key_id)


def test_a_rotation_publishes_both_keys_and_signs_with_the_old_one_until_servers_know(
    capsys: pytest.CaptureFixture[str], cloud: Any
) -> None:
    main(["token", "init", "--cloud"])
    (old,) = published(cloud)

    assert main(["token", "rotate", "--cloud"]) == 0

    assert published(cloud)[0] == old
    assert len(published(cloud)) == 2
    capsys.readouterr()
    _, said = inspected(capsys, issued(capsys, "--cloud"), "--cloud")
    assert said["header"]["kid"] == old
    assert main(["token", "rotate", "--cloud"]) == 2, "the rotation before is not over"


@pytest.mark.parametrize(
    "words",
    [
        ["init"], ["rotate"], ["init", "robot-1", "--cloud"], ["issue", "--cloud"], ["issue"], ["inspect"],
        ["issue", "robot-1", "--cloud", "--key", "k.json"], ["issue", "robot-1", "--cloud", "--keys", "k"],
    ],
)  # fmt: skip
def test_contradicting_arguments_are_refused(
    capsys: pytest.CaptureFixture[str], cloud: Any, words: list[str]
) -> None:
    assert main(["token", *words]) == 2
    assert "hint:" in capsys.readouterr().err


def test_a_token_of_another_signer_fails_the_check(
    capsys: pytest.CaptureFixture[str], platform: Path, tmp_path: Path
) -> None:
    token = issued(capsys)
    (tmp_path / "another").mkdir()
    ensure_key(tmp_path / "another", seed=b"t" * 32, key_id="k")

    code, report = inspected(capsys, token, "--keys", str(key_set_file(tmp_path / "another")))
    assert (code, report["verified"]) == (1, "no: bad-signature-or-claims")


def test_tokens_of_a_retired_key_are_refused(capsys: pytest.CaptureFixture[str], cloud: Any) -> None:
    main(["token", "init", "--cloud"])
    capsys.readouterr()
    stolen = issued(capsys, "--cloud")
    main(["token", "rotate", "--cloud"])
    new = published(cloud)[1]

    assert main(["token", "retire", "--cloud"]) == 2, "servers may not know the new key yet"
    assert main(["token", "retire", "--cloud", "--force"]) == 0

    assert published(cloud) == [new]
    capsys.readouterr()
    assert inspected(capsys, stolen, "--cloud")[1]["verified"] == "no: unknown-key"
    assert inspected(capsys, issued(capsys, "--cloud"), "--cloud")[1]["verified"] == "yes"
