"""Show every setting: value, default, unit, where it comes from, and what it does.

examples:
  rse-pf settings scaling
  rse-pf settings scaling.min_servers
  rse-pf settings --json
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings, setting_rows, settings_page
from rse_pf.config.validation import did_you_mean
from rse_pf.errors import UsageError
from rse_pf.terminal import show, show_json, show_page

__all__ = ["ACTION"]


@dataclass(frozen=True, kw_only=True)
class SettingsRequest:
    """The options of rse-pf settings: which group or setting is shown, and in which format."""

    group: str | None = option(
        nargs="?",
        help="show one group only, such as scaling; or one setting: scaling.min_servers; or: digest",
    )
    json: bool = option("--json", exclusive="format", help="print all values as JSON")
    markdown: bool = option("--markdown", exclusive="format", help="print docs/settings.md")


def show_settings(request: SettingsRequest, settings: PlatformSettings) -> None:
    """Print the settings as a table, as JSON or as the page docs/settings.md, or their digest."""
    values = settings.to_dict()
    if request.group == "digest":
        show(settings.digest())
        return
    if request.markdown:
        show_page(settings_page())
        return
    if request.group is not None:
        values = _choose(request.group, values)
    if request.json:
        show_json(values, indent=2)
        return
    for row in setting_rows(settings):
        if row.name not in values.get(row.group, ()):
            continue
        changed = "" if row.value == row.default else f"  (default {row.default})"
        unit = f" {row.unit}" if row.unit else ""
        show(f"{row.group}.{row.name} = {row.value}{unit}{changed}", f"    {row.doc} [{row.source}]")


def _choose(word: str, values: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return, of *values*, the group *word*, or only the setting *word* if it is ``group.name``.

    Raises:
        UsageError: There is no such group or setting.
    """
    group, dot, name = word.partition(".")
    if group not in values:
        raise UsageError(f"no group named {group[:80]!r}", hint=f"groups are {', '.join(values)}")
    if not dot:
        return {group: values[group]}
    if name not in values[group]:
        full = f"{group}.{name[:80]}"
        names = [f"{group}.{name}" for name in values[group]]
        raise UsageError(f"no setting named {full!r}", hint=did_you_mean(full, names))
    return {group: {name: values[group][name]}}


ACTION = Action(request=SettingsRequest, run=show_settings)
