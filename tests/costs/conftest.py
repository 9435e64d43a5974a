"""The templates whose resources a bill counts."""

from __future__ import annotations

from tests.stacks.conftest import assembly, pytest_collection_modifyitems

__all__ = ["assembly", "pytest_collection_modifyitems"]
