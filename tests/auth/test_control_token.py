"""The token of a control port: one file, its owner's alone, and one judge."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.auth.control_token import bearer, carries_token, ensure_control_token, read_control_token
from rse_pf.errors import UsageError

TOKEN = "0123456789abcdef" * 4


def written(folder: Path, text: bytes, mode: int = 0o600) -> Path:
    path = folder / "control.token"
    path.write_bytes(text)
    path.chmod(mode)
    return path


def test_a_token_is_made_once_and_is_its_owners_alone(tmp_path: Path) -> None:
    path = tmp_path / "control.token"

    first = ensure_control_token(path, seed=b"a" * 32)

    assert first == (b"a" * 32).hex()
    assert path.stat().st_mode & 0o777 == 0o600
    assert ensure_control_token(path, seed=b"b" * 32) == first == read_control_token(path)
    assert [each.name for each in tmp_path.iterdir()] == ["control.token"]


@pytest.mark.parametrize(
    ("text", "mode", "word"),
    [
        (TOKEN.encode(), 0o640, "others may read"),
        (TOKEN.encode(), 0o604, "others may read"),
        (TOKEN[:31].encode(), 0o600, "holds no control token"),
        (b"", 0o600, "holds no control token"),
        (b"x" * 64, 0o600, "holds no control token"),
        (b"\xff" * 64, 0o600, "holds no control token"),
        (TOKEN.encode() + b"\n" + TOKEN.encode(), 0o600, "holds no control token"),
        (b"a" * 4096, 0o600, "holds no control token"),
    ],
)
def test_a_file_without_a_valid_secret_is_refused_in_one_line(
    tmp_path: Path, text: bytes, mode: int, word: str
) -> None:
    path = written(tmp_path, text, mode)

    with pytest.raises(UsageError, match=word) as caught:
        read_control_token(path)

    assert caught.value.hint
    assert "\n" not in caught.value.message
    assert TOKEN[:31] not in caught.value.report()


@pytest.mark.parametrize("header", [bearer(TOKEN), f"bearer {TOKEN}"])
def test_a_header_with_the_token_is_accepted(header: str) -> None:
    assert carries_token(header, TOKEN)


@pytest.mark.parametrize(
    "header",
    [
        "", "Bearer", "Bearer ", TOKEN, f"Basic {TOKEN}", f"Bearer {TOKEN[:-1]}", f"Bearer {TOKEN}0",
        f"Bearer {TOKEN.upper()}", f"Bearer  {TOKEN}", f"Bearer {TOKEN} {TOKEN}", f"Bearer {TOKEN[:-1]}\xe9",
    ],
)  # fmt: skip
def test_any_other_header_is_rejected(header: str) -> None:
    assert not carries_token(header, TOKEN)
