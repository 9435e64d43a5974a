"""A data service in this process, with an empty store in memory."""

from __future__ import annotations

import pytest

from rse_pf.storage.object_store import MemoryStore
from tests.kit.fake_data_service import Service, small_settings


@pytest.fixture
def service() -> Service:
    """A service with an empty store in memory and small limits."""
    return Service(small_settings(), MemoryStore())
