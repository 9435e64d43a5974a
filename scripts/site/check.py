"""Check that no page of a built site loads anything from another host.

    python scripts/site/check.py build/site

The script reads files only.  A link to another host is allowed.  A script, style, font, picture or frame of
another host is an error, since a browser would request it.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from html.parser import HTMLParser
from pathlib import Path

__all__ = ["main", "outside_requests"]

# Attributes by which an HTML element makes a browser load an address.
_LOADS = {
    "script": ("src",), "img": ("src", "srcset"), "iframe": ("src",), "source": ("src", "srcset"),
    "video": ("src", "poster"), "audio": ("src",), "embed": ("src",), "object": ("data",),
    "form": ("action",), "input": ("src",), "use": ("href",), "image": ("href",),
}  # fmt: skip
# Values of ``rel`` with which an element ``link`` makes a browser load its address.
_LINK_LOADS = {
    "stylesheet",
    "icon",
    "preload",
    "prefetch",
    "preconnect",
    "dns-prefetch",
    "modulepreload",
    "manifest",
}
# An address with another host.
_OTHER_HOST = re.compile(r"^\s*(?:https?:)?//", re.IGNORECASE)
# An address of another host that a style sheet loads.
_IN_CSS = re.compile(r"""(?:url\(\s*|@import\s+)["']?\s*((?:https?:)?//[^"')\s]+)""", re.IGNORECASE)
# A text in a script that is an address of another host.
_IN_SCRIPT = re.compile(
    r"""["'`]((?:https?:)?//[a-z0-9-]+\.[a-z0-9.-]+(?:/[^"'`\s]*)?)["'`]""", re.IGNORECASE
)
# Beginnings of names of XML namespaces, which look like addresses and are not loaded.
_NAMESPACES = ("http://www.w3.org/",)


class _Page(HTMLParser):
    """Collects in ``loads`` the addresses that a browser requests in order to show one HTML page."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self._within = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        self._within = tag if tag in ("script", "style") else ""
        self.loads += [attributes[name] for name in _LOADS.get(tag, ()) if name in attributes]
        self.loads += _IN_CSS.findall(attributes.get("style", ""))
        if tag == "link" and set(attributes.get("rel", "").split()) & _LINK_LOADS:
            self.loads.append(attributes.get("href", ""))

    def handle_data(self, data: str) -> None:
        if self._within == "style":
            self.loads += _IN_CSS.findall(data)
        elif self._within == "script":
            self.loads += _IN_SCRIPT.findall(data)


def outside_requests(files: Mapping[str, str]) -> Iterator[str]:
    """Yield what the *files* (path to text) of a site would load from other hosts, one line each."""
    for path, text in files.items():
        if path.endswith(".html"):
            page = _Page()
            page.feed(text)
            foreign = [load for load in page.loads if _OTHER_HOST.match(load)]
        elif path.endswith(".css"):
            foreign = _IN_CSS.findall(text)
        elif path.endswith(".js"):
            foreign = _IN_SCRIPT.findall(text)
        else:
            continue
        yield from (f"{path}: {address}" for address in foreign if not address.startswith(_NAMESPACES))


def main(words: list[str]) -> int:
    """Print each request to another host of the site in the folder ``words[0]``, and their number.

    Returns:
        The exit code: 1 if there is such a request, or the folder has no HTML page; else 0.
    """
    root = Path(words[0])
    files = {
        file.relative_to(root).as_posix(): file.read_text(encoding="utf-8")
        for file in root.rglob("*")
        if file.suffix in (".html", ".css", ".js")
    }
    outside = list(outside_requests(files))
    pages = sum(name.endswith(".html") for name in files)
    for line in outside:
        print(line)
    print(f"{root}: {pages} pages, {len(outside)} requests to other hosts")
    return 1 if outside or not pages else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
