"""An emulated AWS."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.kit.emulated_aws import REGION, emulated_aws


@pytest.fixture
def region(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A region in which nothing is yet."""
    with emulated_aws(monkeypatch, request.node.nodeid):
        yield REGION
