"""Check a built site: every page reachable, no dead link, nothing loaded from another host.

    python scripts/site/check.py build/site

It reads files only.  A link to another host is a link, and allowed; a script, style, font, picture or frame
of another host is a request, and is not.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

__all__ = ["dead_links", "main", "outside_requests"]

_LOADS = {
    "script": ("src",), "img": ("src", "srcset"), "iframe": ("src",), "source": ("src", "srcset"),
    "video": ("src", "poster"), "audio": ("src",), "embed": ("src",), "object": ("data",),
    "form": ("action",), "input": ("src",), "use": ("href",), "image": ("href",),
}  # fmt: skip
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
_OTHER_HOST = re.compile(r"^\s*(?:https?:)?//", re.IGNORECASE)
_IN_CSS = re.compile(r"""(?:url\(\s*|@import\s+)["']?\s*((?:https?:)?//[^"')\s]+)""", re.IGNORECASE)
_IN_SCRIPT = re.compile(
    r"""["'`]((?:https?:)?//[a-z0-9-]+\.[a-z0-9.-]+(?:/[^"'`\s]*)?)["'`]""", re.IGNORECASE
)
_NAMESPACES = ("http://www.w3.org/",)


class _Page(HTMLParser):
    """The links, anchors and loads of one page."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.loads: list[str] = []
        self._within = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        self._within = tag if tag in ("script", "style") else ""
        self.anchors |= {attributes[name] for name in ("id", "name") if name in attributes}
        self.loads += [attributes[name] for name in _LOADS.get(tag, ()) if name in attributes]
        self.loads += _IN_CSS.findall(attributes.get("style", ""))
        if tag == "link" and set(attributes.get("rel", "").split()) & _LINK_LOADS:
            self.loads.append(attributes.get("href", ""))
        if tag == "a" and "href" in attributes:
            self.links.append(attributes["href"])

    def handle_data(self, data: str) -> None:
        if self._within == "style":
            self.loads += _IN_CSS.findall(data)
        elif self._within == "script":
            self.loads += _IN_SCRIPT.findall(data)


def read_page(text: str) -> _Page:
    """Return the parsed page."""
    page = _Page()
    page.feed(text)
    return page


def outside_requests(files: Mapping[str, str]) -> Iterator[str]:
    """Yield what the *files* (path to text) of a site would load from other hosts, one line each."""
    for path, text in files.items():
        if path.endswith(".html"):
            foreign = [load for load in read_page(text).loads if _OTHER_HOST.match(load)]
        elif path.endswith(".css"):
            foreign = _IN_CSS.findall(text)
        elif path.endswith(".js"):
            foreign = _IN_SCRIPT.findall(text)
        else:
            continue
        yield from (f"{path}: {address}" for address in foreign if not address.startswith(_NAMESPACES))


def dead_links(files: Mapping[str, str], others: set[str]) -> Iterator[str]:
    """Yield the links of pages to pages, anchors and files that do not exist, one line each.

    Args:
        files: The text files of a site, by path.
        others: Paths of its other files.
    """
    pages = {path: read_page(text) for path, text in files.items() if path.endswith(".html")}
    known = set(files) | others
    for path, page in pages.items():
        for link in page.links:
            address = urlsplit(link)
            if address.scheme in ("http", "https", "mailto", "javascript") or address.netloc:
                continue
            target = _resolved(path, unquote(address.path)) if address.path else path
            anchor = unquote(address.fragment)
            if target not in known:
                yield f"{path}: {link}"
            elif (
                anchor
                and target in pages
                and not anchor.startswith("__")
                and anchor not in pages[target].anchors
            ):
                yield f"{path}: {link}: no such anchor"


def _resolved(page: str, link: str) -> str:
    parts = [] if link.startswith("/") else page.split("/")[:-1]
    for part in link.split("/"):
        if part == "..":
            parts = parts[:-1]
        elif part not in ("", "."):
            parts.append(part)
    path = "/".join(parts)
    return f"{path}/index.html".lstrip("/") if link.endswith("/") or not path else path


def main(words: list[str]) -> int:
    """Print what is wrong with a built site; return 1 if anything is."""
    root = Path(words[0])
    files, others = {}, set()
    for file in root.rglob("*"):
        if file.is_file():
            name = file.relative_to(root).as_posix()
            if file.suffix in (".html", ".css", ".js"):
                files[name] = file.read_text(encoding="utf-8")
            else:
                others.add(name)
    dead = list(dead_links(files, others))
    outside = list(outside_requests(files))
    pages = sum(name.endswith(".html") for name in files)
    for line in (*dead, *outside):
        print(line)
    print(f"{root}: {pages} pages, {len(dead)} dead links, {len(outside)} requests to other hosts")
    return 1 if dead or outside or not pages else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
