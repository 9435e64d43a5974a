"""Parts of the Markdown reports that all experiments share: tables, numbers, and the description of a run.

The functions format figures of a report; they compute none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

__all__ = ["about_run", "failures", "number", "page", "slashed", "table", "three"]


def page(*blocks: str | Sequence[str]) -> str:
    """Return a page of *blocks* (paragraphs, or the lines of a table) with an empty line between them."""
    return "\n\n".join(block if isinstance(block, str) else "\n".join(block) for block in blocks) + "\n"


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    """Return the lines of a Markdown table with the column titles *head*."""
    return [
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(str(value) for value in row) + " |" for row in rows),
    ]


def number(value: Any) -> str:
    """Return *value* as text: a float with at most six significant digits, and "-" for None."""
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def three(percentiles: Mapping[str, Any]) -> str:
    """Return the text "p50 / p95 / p99" with the values of *percentiles*."""
    return " / ".join(number(percentiles.get(name)) for name in ("p50", "p95", "p99"))


def slashed(values: Mapping[str, Any], *names: str) -> str:
    """Return the values of *names* as one text, separated by " / "."""
    return " / ".join(number(values[name]) for name in names)


def failures(report: Mapping[str, Any]) -> str:
    """Return the number of failed commands as text, with the number for each error code in parentheses."""
    codes = ", ".join(f"{code} {count}" for code, count in report["failures_by_code"].items())
    return f"{report['commands']['failed']} ({codes})" if codes else str(report["commands"]["failed"])


def about_run(report: Mapping[str, Any]) -> str:
    """Return the paragraph on a run's commit, load average, machine, versions, settings and generators."""
    about = report["environment"]
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    generators = "".join(
        f" Load generator ({name or 'run'}): {100 * value['cpu_s'] / max(value['wall_s'], 1e-9):.0f} % of a "
        f"core, {value['wrong_poses']} wrong poses."
        for name, value in (report.get("generator") or {}).items()
    )
    commit = f"Commit {about['commit']}. " if about.get("commit") else ""
    return (
        f"{commit}Load average before the run {about['load_average']}, "
        f"after it {about['load_average_after']}; {about['cores']} cores, {about['system']}, "
        f"Python {about['python']}; {versions}; settings digest "
        f"{about['settings_digest']}.{generators}"
    )
