"""Load the services of a server by the name of the function that makes their registry."""

from __future__ import annotations

import importlib
from collections.abc import Callable

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.service import Registry

__all__ = ["load_services"]


def load_services(name: str, settings: PlatformSettings) -> Registry:
    """Return the registry of services that the function *name* makes of *settings*.

    Args:
        name: ``module:function``, such as ``rse_pf.services.builtin:builtin_services``.
        settings: Settings of the platform.

    Raises:
        ConfigurationError: There is no such module or function, or the module cannot be imported.
    """
    module, _, function = name.partition(":")
    try:
        make: Callable[[PlatformSettings], Registry] = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(
            f"no services at {name!r}: {error}", hint="name them as module:function"
        ) from error
    return make(settings)
