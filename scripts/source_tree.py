"""Write ``docs/explanation/source_tree.md``: every module with the first sentence of its docstring.

The page is computed from the sources alone, so equal sources give equal bytes.  What imports what is in the
picture of ``scripts/architecture.py``.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from pathlib import Path

__all__ = ["first_sentence", "main", "page", "read_sources"]

TOPS = (
    "rse_pf", "client_sdk", "lambda_pnp", "ros_bridge", "stacks", "benchmarks", "scripts", "fuzz",
)  # fmt: skip
TARGET = "docs/explanation/source_tree.md"

_BEGINNING = """# Where is what in the source tree?

`make docs` writes this page from the docstrings. It has many lines because every package and every module
has one: the first sentence of its docstring. Search for the subject. [The architecture](../architecture.md)
shows what imports what, and follows a frame, a setting and a token through the files.

- `client_cpp`, `client_web`: the clients in C++ and for browsers and Node; each README names the files.
- `native`: the optional core in C++, which decodes messages, solves poses and matches features.
- `tests`: the same folders as the sources. `tests/system` starts processes, `tests/hostile` attacks them, and
  `tests/laws` checks rules about the code.
- `examples`: programs and services to copy. `docs`: these pages. `locks`: the hashed locks of all packages.
"""
_END = re.compile(r"(?<!\bFig)(?<!\bSect)(?<!e\.g)\.(?=\s|$)")


def read_sources(repository: Path) -> dict[str, str]:
    """Return the text of every Python file of the folders in `TOPS`, by path."""
    return {
        path.relative_to(repository).as_posix(): path.read_text(encoding="utf-8")
        for top in TOPS
        for path in sorted((repository / top).rglob("*.py"))
        if "templates" not in path.parts
    }


def first_sentence(text: str) -> str:
    """Return the first sentence of the docstring of a module, as Markdown in one line; empty without one."""
    docstring = " ".join((ast.get_docstring(ast.parse(text)) or "").partition("\n\n")[0].split())
    end = _END.search(docstring)
    sentence = docstring[: end.end()] if end else docstring
    return sentence.replace("``", "`").replace("<", "&lt;").replace("*", "\\*")


def page(sources: Mapping[str, str]) -> str:
    """Return the page about *sources* (path to text): a section for each folder, in the order of `TOPS`."""
    modules: dict[str, list[str]] = {}
    for path in sources:
        modules.setdefault(path.rpartition("/")[0], []).append(path)
    sections = []
    for folder in sorted(modules, key=lambda name: (TOPS.index(name.partition("/")[0]), name)):
        lines = [f"## {folder}\n"]
        package = first_sentence(sources.get(f"{folder}/__init__.py", ""))
        if package:
            lines.append(f"{package}\n")
        for path in sorted(modules[folder]):
            name = path.rpartition("/")[2]
            if name != "__init__.py":
                lines.append(f"- `{name}`: {first_sentence(sources[path])}")
        sections.append("\n".join(lines).rstrip("\n") + "\n")
    return "\n".join([_BEGINNING, *sections])


def main() -> None:
    """Write the page of this checkout."""
    repository = Path(__file__).resolve().parents[1]
    (repository / TARGET).write_text(page(read_sources(repository)), encoding="utf-8")


if __name__ == "__main__":
    main()
