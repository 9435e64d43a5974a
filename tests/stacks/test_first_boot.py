"""The boot script's signature, and how little of the machine's script Amazon allows."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

from lambda_pnp.keys import signed_request
from stacks.boot.first_boot import signed_headers

NOW = datetime(2026, 11, 21, 6, 0, 0, tzinfo=timezone.utc)
USER_DATA_BYTES = 16384


def test_the_boot_script_signs_as_the_function_does() -> None:
    theirs = signed_request(
        {
            "RSE_PF_KEYS": "artifacts/keys.json", "AWS_REGION": "ap-northeast-2", "AWS_ACCESS_KEY_ID": "AKID",
            "AWS_SECRET_ACCESS_KEY": "secret", "AWS_SESSION_TOKEN": "session",
        },
        NOW,
    )  # fmt: skip
    credentials = {"AccessKeyId": "AKID", "SecretAccessKey": "secret", "Token": "session"}

    ours = signed_headers(
        "artifacts.s3.ap-northeast-2.amazonaws.com", "/keys.json", "ap-northeast-2", credentials, NOW
    )

    assert ours["authorization"] == theirs.get_header("Authorization")


def test_the_script_fits_into_the_user_data(repository: Path) -> None:
    assert len((repository / "stacks/boot/first_boot.py").read_bytes()) < USER_DATA_BYTES - 1024
