"""Load the registry of services from its name, ``module:function``."""

from __future__ import annotations

import importlib
from collections.abc import Callable

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.service import Registry

__all__ = ["load_services"]


def load_services(name: str, settings: PlatformSettings) -> Registry:
    """Return the registry that ``module:function`` returns for *settings*; raises ConfigurationError."""
    module, _, function = name.partition(":")
    try:
        make: Callable[[PlatformSettings], Registry] = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(
            f"no services at {name!r}: {error}", hint="name them as module:function"
        ) from error
    return make(settings)
