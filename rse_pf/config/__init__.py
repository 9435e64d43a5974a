"""Settings as data, their validation, the page that documents them, and names of cloud resources.

Every number an operator may change belongs here; what reads it, and anything with a socket, does not.
"""

from rse_pf.config.schema import SettingRow
from rse_pf.config.settings import (
    AuthSettings,
    CloudSettings,
    DataSettings,
    HealthSettings,
    LocalSettings,
    PlatformSettings,
    PnpSettings,
    ScalingSettings,
    ServiceSettings,
    ServingSettings,
    SessionSettings,
    load_settings,
    setting_rows,
    settings_page,
)

__all__ = [
    "AuthSettings",
    "CloudSettings",
    "DataSettings",
    "HealthSettings",
    "LocalSettings",
    "PlatformSettings",
    "PnpSettings",
    "ScalingSettings",
    "ServiceSettings",
    "ServingSettings",
    "SessionSettings",
    "SettingRow",
    "load_settings",
    "setting_rows",
    "settings_page",
]
