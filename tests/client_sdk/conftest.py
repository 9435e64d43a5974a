"""What the tests of the SDK share: the fakes of ``tests/fakes.py``."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


def _load() -> ModuleType:
    file = Path(__file__).resolve().parents[1] / "fakes.py"
    spec = importlib.util.spec_from_file_location("rse_pf_fakes", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def fakes() -> ModuleType:
    """The module ``tests/fakes.py``."""
    return sys.modules.get("rse_pf_fakes") or _load()
