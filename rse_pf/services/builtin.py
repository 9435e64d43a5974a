"""The services that every server of the platform offers."""

from __future__ import annotations

from rse_pf.config import PlatformSettings
from rse_pf.service import Registry
from rse_pf.services import echo, pnp
from rse_pf.services.mapping import icp, localise, merge, optimise, place, wifi

__all__ = ["builtin_services"]


def builtin_services(settings: PlatformSettings) -> Registry:
    """Return a registry with the platform's own services, configured by *settings*.

    Raises:
        MissingExtra: The native core, which the service ``pnp`` needs, is not installed.
    """
    registry = Registry()
    pnp.register(registry, settings.pnp)
    echo.register(registry)
    # These services import optional packages at their first command; without them they answer
    # `missing-extra`.
    for service in (icp, place, localise, merge, optimise, wifi):
        service.register(registry)
    return registry
