"""An emulated AWS in this process."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

REGION = "ap-northeast-2"


@pytest.fixture
def region(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A region in which nothing is yet."""
    moto = pytest.importorskip("moto", reason="the dev extra is not installed")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    with moto.mock_aws():
        yield REGION
