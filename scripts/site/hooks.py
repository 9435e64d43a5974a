"""Hooks of the documentation site: pages that are generated, and links that leave the folder ``docs``.

The pages for the command line, the metrics and the SDK are written from the sources while the site is built,
so that they are never out of date.  The first page is the README.  Nothing is written into ``docs``.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
for each in (ROOT, Path(__file__).parent):
    if str(each) not in sys.path:
        sys.path.insert(0, str(each))

import pages  # noqa: E402  (in the folder of this file)

# Addresses of other hosts in the scripts of the theme.
_OTHER_HOST = re.compile(r"https://(?:unpkg\.com|api\.github\.com|gitlab\.com)/[^\"'`]*")


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages and the style sheet of the site."""
    from mkdocs.structure.files import File

    for uri, content in pages.generated(ROOT).items():
        files.append(File.generated(config, uri, content=content))
    files.append(File.generated(config, "site.css", abs_src_path=str(Path(__file__).parent / "site.css")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace links to files outside of ``docs`` by links to their listings on the site."""
    return pages.inside(ROOT, page.file.src_uri, markdown)


def on_post_build(config: Any) -> None:
    """Remove the addresses of other hosts from the theme's scripts.

    The theme would load a diagram library and a polyfill from other hosts, and ask GitHub for the number of
    stars; our pages need none of these.
    """
    for script in Path(config["site_dir"]).rglob("*.js"):
        text = script.read_text(encoding="utf-8")
        cleaned = _OTHER_HOST.sub("", text)
        if cleaned != text:
            script.write_text(cleaned, encoding="utf-8")
    for source_map in Path(config["site_dir"]).rglob("*.map"):
        source_map.unlink()
