"""Make the generated pages of the documentation site as Markdown: SDK, command line, metrics, README.

The pages are computed from the sources of one checkout.  This module writes no files and needs no extra.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import re
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import msgspec

__all__ = ["SDK", "cli_page", "generated", "inside", "metrics_page", "moved", "sdk_page", "sources"]

SDK = {
    "Connect": (
        "connect", "connect_blocking", "Robot", "BlockingRobot", "CloudFirst", "Answer", "PoseAnswer",
        "decode_reply", "Stats",
    ),
    "Track and map": (
        "Mapper", "BlockingMapper", "TrackedFrame", "Frame", "FrontEndOptions", "MonocularOptions",
        "MarkerScale", "OdometryScale", "OdometryReading", "Tracker", "PoseQuery", "MapOptions", "PointMap",
        "Trajectory",
    ),
    "Recordings": ("Dataset", "open_dataset"),
    "Large data": ("DataClient", "DataOptions"),
}  # fmt: skip
"""Names of `client_sdk` by section of the SDK page; public names without a section are put into "More"."""
_MODULES = ("client_sdk.cameras", "rse_pf.geometry", "rse_pf.pnp", "rse_pf.auth.robot_key", "rse_pf.service")
"""Further modules whose public names a robot's program or a service uses."""
# Modules that define the metrics.
_METRIC_SOURCES = ("rse_pf/server/metrics.py", "rse_pf/local/control/federation.py")
# Type of a metric by the class of `prometheus_client` that makes it.
_FAMILIES = {
    "CounterMetricFamily": "counter",
    "GaugeMetricFamily": "gauge",
    "HistogramMetricFamily": "histogram",
}
# A link in Markdown, with its target as the second group.
_LINK = re.compile(r"(\]\()([^)\s]+)(\))")
_LISTED = {".py": "python", ".md": "markdown", ".json": "json", ".lua": "lua", ".cpp": "cpp", ".sh": "sh"}
"""Language by ending of the files that have a listing: a page of the site with the text of the file."""
_WIDTH = "96"  # width in characters of the help pages


def generated(root: Path) -> dict[str, str]:
    """Return the text of each generated page by its address on the site."""
    return {
        "index.md": moved((root / "README.md").read_text(encoding="utf-8")),
        "contributing.md": moved((root / "CONTRIBUTING.md").read_text(encoding="utf-8")),
        "changelog.md": moved((root / "CHANGELOG.md").read_text(encoding="utf-8")),
        "reference/sdk.md": sdk_page(),
        "reference/cli.md": cli_page(),
        "reference/metrics.md": metrics_page(root),
        **sources(root),
    }


def moved(text: str) -> str:
    """Return *text*, a page of the repository's root folder, with links that are valid in ``docs``."""
    names = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md", "README.md": "index.md"}

    def link(found: re.Match[str]) -> str:
        target, mark, anchor = found[2].partition("#")
        if target.startswith("docs/"):
            target = target.removeprefix("docs/")
        target = names.get(target, target)
        if target == "LICENSE":
            return "](https://www.apache.org/licenses/LICENSE-2.0)"
        return f"{found[1]}{target}{mark}{anchor}{found[3]}"

    return _LINK.sub(link, text)


def sources(root: Path) -> dict[str, str]:
    """Return the listings of all files outside of ``docs`` to which a page links, by address on the site.

    A listing is a page with the text of a file; only files with an ending of `_LISTED` have one.
    """
    found = {}
    for page in sorted((root / "docs").rglob("*.md")):
        for _, link, _ in _LINK.findall(page.read_text(encoding="utf-8")):
            name = _outside(root, page.relative_to(root / "docs").as_posix(), link)
            if name and (root / name).suffix in _LISTED:
                text = (root / name).read_text(encoding="utf-8")
                found[f"source/{name}.md"] = (
                    f"# `{name}`\n\n```{_LISTED[(root / name).suffix]}\n{text.rstrip()}\n```\n"
                )
    return found


def inside(root: Path, page: str, text: str) -> str:
    """Return *text*, a page of ``docs``, whose links to files outside of ``docs`` lead to their listings.

    The listing of a file is the page of the site with its text, see `sources`.  A link to a folder, or to a
    file without a listing, is replaced by its own text as code.  Other links are unchanged.
    """

    def link(found: re.Match[str]) -> str:
        name = _outside(root, page, found[2])
        if not name:
            return found[0]
        if (root / name).suffix not in _LISTED:
            return f"{found[1]}\0"
        up = "../" * page.count("/")
        return f"{found[1]}{up}source/{name}.md{found[3]}"

    linked = _LINK.sub(link, text)
    return re.sub(r"\[([^\[\]]*)\]\(\0", r"`\1`", linked)


def _outside(root: Path, page: str, link: str) -> str:
    """Return the file or folder outside of ``docs`` to which a link leads, relative to *root*.

    The result is empty if the link leads to a page of ``docs``, to another host, or to no existing file.
    """
    target = link.partition("#")[0]
    if not target or "://" in target:
        return ""
    path = Path(os.path.normpath(root / "docs" / Path(page).parent / target))
    if not path.exists() or path.is_relative_to(root / "docs"):
        return ""
    return path.relative_to(root).as_posix()


def sdk_page() -> str:
    """Return the page of the SDK: one directive of mkdocstrings for each public name."""
    sdk: Any = importlib.import_module("client_sdk")
    placed = {name for names in SDK.values() for name in names}
    rest = tuple(name for name in sdk.__all__ if name not in placed)
    sections = {**SDK, **({"More": rest} if rest else {})}
    lines = [
        "# Which classes and functions does the SDK have?",
        "",
        "This page is generated from the docstrings. What it does not list may change in any version.",
        "The names of the first sections are imported from `client_sdk`, the others from the module of",
        "their heading.",
        "",
    ]
    for title, names in sections.items():
        lines += [f"## {title}", ""]
        lines += [_directive(f"client_sdk.{name}") for name in names]
    for module in _MODULES:
        lines += [f"## `{module}`", ""]
        lines += [_directive(f"{module}.{name}") for name in _public_names(module)]
    return "\n".join(lines) + "\n"


def _directive(path: str) -> str:
    """Return the directive by which mkdocstrings documents the public name *path*.

    Fields are documented as well if the docstring does not list them.
    """
    lines = [f"::: {path}", "    options:", "      heading_level: 3"]
    module, _, name = path.rpartition(".")
    described = getattr(importlib.import_module(module), name)
    has_fields = is_dataclass(described) or issubclass(type(described), type(msgspec.Struct))
    if has_fields and "Attributes:" not in (described.__doc__ or ""):
        lines.append("      show_if_no_docstring: true")
    return "\n".join(lines) + "\n"


def _public_names(module: str) -> list[str]:
    """Return ``__all__`` of a module, in the order of its source; empty if it has none."""
    root = Path(__file__).resolve().parents[2]
    base = root.joinpath(*module.split("."))
    file = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return [str(name) for name in ast.literal_eval(node.value)]
    return []


def cli_page() -> str:
    """Return the help pages of all verbs and their actions, as the parsers print them."""
    from rse_pf.cli.main import VERBS, parser_of

    lines = [
        "# Which commands does `rse-pf` have?",
        "",
        "This page is generated from the parsers: it is what `rse-pf VERB --help` prints.",
        "",
        "| verb | what it does |",
        "|---|---|",
        *(f"| [`{verb}`](#rse-pf-{verb}) | {line} |" for verb, line in VERBS.items()),
        "",
    ]
    for verb in VERBS:
        parser = parser_of(verb)
        lines += [f"## rse-pf {verb}", "", *_help(parser)]
        for name, sub in _actions(parser):
            lines += [f"### rse-pf {verb} {name}", "", *_help(sub)]
    return "\n".join(lines) + "\n"


def _actions(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.items()


def _help(parser: argparse.ArgumentParser) -> list[str]:
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _WIDTH
    try:
        text = parser.format_help()
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
    return ["```text", text.rstrip(), "```", ""]


def metrics_page(root: Path) -> str:
    """Return the table of all metrics, from the sources that make them."""
    rows = sorted(
        {row for source in _METRIC_SOURCES for row in _metrics((root / source).read_text(encoding="utf-8"))}
    )
    lines = [
        "# Which metrics does a platform have?",
        "",
        "This page is generated from the sources. `/metrics` of a server, and the one address of a platform",
        "of one machine ([how to scrape it](../local.md#metrics-for-prometheus)), give them in the text",
        "format of Prometheus.",
        "Counters end in `_total` there. No label contains the name of a robot.",
        "",
        "| metric | type | meaning |",
        "|---|---|---|",
        *(f"| `{name}` | {kind} | {doc} |" for name, kind, doc in rows),
    ]
    return "\n".join(lines) + "\n"


def _metrics(text: str) -> Iterator[tuple[str, str, str]]:
    """Yield name, type and meaning of each metric that a module makes."""
    module = ast.parse(text)
    for node in ast.walk(module):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "GAUGE_HELP":
            for name, doc in ast.literal_eval(node.value).items():
                yield f"rse_pf_{name}", "gauge", doc
        if isinstance(node, ast.Call) and len(node.args) >= 2:
            called = ast.unparse(node.func)
            name, doc = node.args[:2]
            if isinstance(name, ast.Constant) and isinstance(doc, ast.Constant):
                if called == "counter":
                    yield f"rse_pf_{name.value}", "counter", str(doc.value)
                elif called in _FAMILIES:
                    yield str(name.value), _FAMILIES[called], str(doc.value)
