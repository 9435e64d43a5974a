"""The settings of the platform: one table, its checks, the file they come from and the page about them.

Numbers that an operator may change belong here; code that uses them, or opens a socket, does not.
"""

from rse_pf.config.loading import load_settings
from rse_pf.config.reference_page import settings_page
from rse_pf.config.settings import (
    AuthSettings,
    BurstSettings,
    CloudSettings,
    DataSettings,
    HealthSettings,
    LiveSettings,
    LocalSettings,
    PlatformSettings,
    PnpSettings,
    RecordingSettings,
    ScalingSettings,
    ServiceSettings,
    ServingSettings,
    SessionSettings,
    setting_rows,
)
from rse_pf.config.validation import SettingRow

__all__ = [
    "AuthSettings",
    "BurstSettings",
    "CloudSettings",
    "DataSettings",
    "HealthSettings",
    "LiveSettings",
    "LocalSettings",
    "PlatformSettings",
    "PnpSettings",
    "RecordingSettings",
    "ScalingSettings",
    "ServiceSettings",
    "ServingSettings",
    "SessionSettings",
    "SettingRow",
    "load_settings",
    "setting_rows",
    "settings_page",
]
