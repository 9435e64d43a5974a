"""Every code block of every page is executed by a test, or is parsed and says why it is not executed."""

from __future__ import annotations

import ast
import importlib
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from scripts.site.blocks import MARKS, RUN_BY_OTHERS, Block, all_blocks, commands_of, how, pages, read_blocks

yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")

PAGE = """# Title

Needs an account:

```
rse-pf cloud doctor
```

<!-- file: Robot.py -->
```python
import json
```

Some words.

    scrape_configs:
      - job_name: x

```
TOKEN=$(rse-pf token issue robot-1)
rse-pf demo > log  # comment
```

```text
no code
```
"""


def complaints(blocks: list[Block]) -> Iterator[str]:
    """Yield what is wrong with blocks of code that are not commands, one line each."""
    for block in blocks:
        place = f"{block.page}:{block.line}"
        try:
            if block.language == "python":
                flags = ast.PyCF_ONLY_AST | ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
                tree = compile(block.text.replace(", ...}", "}"), place, "exec", flags)
                yield from (f"{place}: {each}" for each in _missing(tree))
            elif block.language == "json":
                json.loads(block.text)
            elif block.language == "yaml":
                yaml.safe_load(block.text)
            elif block.language:
                yield f"{place}: nobody parses {block.language}; write text if it is no code"
        except (SyntaxError, ValueError, yaml.YAMLError) as error:
            yield f"{place}: {error}"


def _missing(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            module = importlib.import_module(node.module)
            yield from (
                f"{node.module} has no {each.name}" for each in node.names if not hasattr(module, each.name)
            )


def test_every_block_of_every_page_can_be_parsed(repository: Path) -> None:
    assert list(complaints(all_blocks(repository))) == []


def test_every_block_is_executed_or_says_why_not(repository: Path) -> None:
    found = [how(block) for block in all_blocks(repository)]

    assert set(found) <= {"executed", "parsed", *MARKS}
    assert found.count("executed") >= 40


UNKNOWN = re.compile(r"^<!-- (?!file: )([^>]*?) -->\n(?:```|\n {4})", re.MULTILINE)


def test_every_mark_is_one_of_the_list(repository: Path) -> None:
    told = {
        mark for page in pages(repository) for mark in UNKNOWN.findall((repository / page).read_text("utf-8"))
    }

    assert told <= set(MARKS)
    assert UNKNOWN.findall("<!-- takes minutes -->\n```\nmake fuzz\n```\n") == ["takes minutes"]


def test_the_tests_that_execute_pages_exist(repository: Path) -> None:
    known = pages(repository)

    for page, test in RUN_BY_OTHERS.items():
        assert page in known
        assert Path(page).name in (repository / test).read_text(encoding="utf-8")


def test_marks_files_languages_and_commands_are_read() -> None:
    doctor, program, scrape, demo = read_blocks("docs/page.md", PAGE)

    assert (doctor.mark, how(doctor)) == ("needs an account", "needs an account")
    assert (program.file, program.language, how(program)) == ("Robot.py", "python", "executed")
    assert (scrape.language, how(scrape)) == ("yaml", "parsed")
    assert commands_of(demo) == ["rse-pf token issue robot-1", "rse-pf demo"]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("```python\nprint(\n```\n", "never closed"),
        ("```python\nfrom client_sdk import Nobody\n```\n", "client_sdk has no Nobody"),
        ("```json\n{,}\n```\n", "Expecting"),
        ("```yaml\na: [\n```\n", "parsing"),
        ("```rust\nfn main() {}\n```\n", "nobody parses rust"),
    ],
)
def test_a_block_that_cannot_be_parsed_is_noticed(text: str, complaint: str) -> None:
    assert any(complaint in line for line in complaints(list(read_blocks("docs/page.md", text))))
