"""Write ``docs/settings.md`` from the table of settings."""

from __future__ import annotations

import json

from rse_pf.config.settings import PlatformSettings, setting_rows
from rse_pf.config.validation import SettingRow

__all__ = ["settings_page"]

_HEAD = """# Settings

`make docs` writes this page from `rse_pf/config/settings.py`. Override a setting in `cdk.json`:
`{"context": {"rse-pf": {"scaling": {"max_servers": 4}}}}`. `rse-pf settings` prints the values in force.
"""
_TABLE = "| Setting | Default | Allowed | Meaning |\n|---|---|---|---|\n"
_OWN_CHOICE = "ours"
"""``SettingRow.source`` of a value that this project chose; the page shows every other source."""


def settings_page() -> str:
    """Return the page ``docs/settings.md``: default, unit, range, meaning and source of each setting."""
    page, group = _HEAD, ""
    for row in setting_rows():
        if row.group != group:
            group = row.group
            page += f"\n## {group}\n\n{getattr(PlatformSettings(), group).__doc__}\n\n{_TABLE}"
        cells = (
            f"`{row.name}`",
            f"`{json.dumps(row.default)}` {row.unit}".rstrip(),
            _allowed(row),
            row.doc if row.source == _OWN_CHOICE else f"{row.doc} (source: {row.source})",
        )
        page += "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"
    return page


def _allowed(row: SettingRow) -> str:
    """Return the choices or the range of a setting as text, "" if every value of its type is allowed."""
    if row.choices:
        return ", ".join(f"`{choice}`" for choice in row.choices)
    if row.low is None and row.high is None:
        return ""
    if row.high is None:
        return f"from {row.low:.12g}"
    return f"{row.low:.12g} to {row.high:.12g}" if row.low is not None else f"up to {row.high:.12g}"
