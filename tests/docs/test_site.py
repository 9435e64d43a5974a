"""The documentation site: generated pages are complete, and a built site loads nothing from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import client_sdk
from rse_pf.backend.metrics import Metrics, merge, render
from rse_pf.cli.main import VERBS
from scripts.site.blocks import is_executed, read_blocks
from scripts.site.check import dead_links, outside_requests
from scripts.site.pages import cli_page, inside, metrics_page, moved, sdk_page

MAX_CPU_S = 60.0
PAGE_WITH_BLOCKS = """# Title

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
rse-pf demo
```

```text
no code
```
"""


def test_the_page_of_the_command_line_has_every_verb() -> None:
    page = cli_page()

    for verb in VERBS:
        assert f"\n## rse-pf {verb}\n" in page
        assert f"usage: rse-pf {verb} " in page
    assert "usage: rse-pf map merge " in page


def test_the_page_of_the_sdk_has_every_public_name() -> None:
    page = sdk_page()

    assert [name for name in client_sdk.__all__ if f"::: client_sdk.{name}\n" not in page] == []
    assert "::: rse_pf.auth.robot_key.RobotKey\n" in page


@pytest.mark.parametrize("name", ["Frame", "TrackedFrame", "Answer", "Stats"])
def test_the_page_of_the_sdk_lists_the_fields_of_dataclasses(name: str) -> None:
    (directive,) = re.findall(rf"^::: client_sdk\.{name}\n((?: .*\n)+)", sdk_page(), re.MULTILINE)

    assert "show_if_no_docstring: true" in directive


def test_the_page_of_metrics_has_what_a_server_gives(repository: Path) -> None:
    metrics = Metrics()
    metrics.count_answer("pnp", "ok", 0.01)
    metrics.gauges["robots"] = 1.0
    told = render(merge([metrics.snapshot()])).decode()
    page = metrics_page(repository)

    families = re.findall(r"^# TYPE (\w+) (\w+)$", told, re.MULTILINE)
    assert families
    for name, kind in families:
        assert f"| `{name.removesuffix('_total')}` | {kind} | " in page
    assert "`rse_pf_server_up`" in page


def test_every_page_is_in_the_menu(repository: Path) -> None:
    menu = (repository / "scripts/site/mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    listed = set(re.findall(r"(\S+\.md)$", menu, re.MULTILINE))
    pages = {each.relative_to(repository / "docs").as_posix() for each in repository.glob("docs/**/*.md")}

    # The page of the results leads to the reports.
    assert {page for page in pages - listed if not page.startswith("results/")} == set()


def test_marks_files_and_languages_of_code_blocks_are_read() -> None:
    doctor, program, scrape, demo = read_blocks("docs/page.md", PAGE_WITH_BLOCKS)

    assert doctor.mark == "needs an account"
    assert (program.file, program.language) == ("Robot.py", "python")
    assert scrape.language == "yaml"
    assert demo.text == "rse-pf demo\n"
    assert [is_executed(block) for block in (doctor, program, scrape, demo)] == [False, True, False, True]


def test_links_of_the_readme_are_those_of_the_site() -> None:
    text = (
        "[a](docs/local.md#x) [b](CONTRIBUTING.md) ![c](docs/images/c.gif) [d](https://example.org/docs/x.md)"
    )

    assert moved(text) == (
        "[a](local.md#x) [b](contributing.md) ![c](images/c.gif) [d](https://example.org/docs/x.md)"
    )


def test_links_to_files_of_the_checkout_lead_to_listings(repository: Path) -> None:
    text = "[a](../examples/services/icp-python/service.py) [b](../examples/services) [c](data.md) [d](#x)"

    assert inside(repository, "examples.md", text) == (
        "[a](source/examples/services/icp-python/service.py.md) `b` [c](data.md) [d](#x)"
    )


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.html", '<script src="https://cdn.example.org/x.js"></script>'),
        ("a.html", '<link rel="stylesheet" href="//fonts.example.org/css">'),
        ("a.html", '<link rel="preconnect" href="https://fonts.example.org">'),
        ("a.html", '<img src="http://example.org/pixel.gif">'),
        ("a.html", "<style>@import 'https://example.org/a.css';</style>"),
        ("a.html", '<p style="background: url(https://example.org/a.png)">'),
        ("a.html", '<script>fetch("https://example.org/count")</script>'),
        ("a.css", "@font-face { src: url(https://example.org/a.woff2) }"),
        ("a.js", 'load("https://unpkg.example.com/mermaid.js")'),
    ],
)
def test_a_request_to_another_host_is_noticed(name: str, text: str) -> None:
    assert len(list(outside_requests({name: text}))) == 1


def test_links_and_namespaces_are_no_requests() -> None:
    page = (
        '<a href="https://example.org">x</a><svg xmlns="http://www.w3.org/2000/svg"></svg><img src="a.png">'
    )

    assert list(outside_requests({"a.html": page, "a.js": 'x="http://www.w3.org/2000/svg"'})) == []


def test_a_dead_link_of_a_site_is_noticed() -> None:
    files = {
        "a/b.html": '<a href="../c.html#x"></a><a href="../c.html#y"></a><a href="d.html"></a>',
        "c.html": '<p id="x">',
    }

    assert list(dead_links(files, set())) == ["a/b.html: ../c.html#y: no such anchor", "a/b.html: d.html"]


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mkdocs") is None, reason="the extra docs is not installed: make site")
def test_the_site_is_built_in_a_minute_of_cpu_time_without_dead_links(repository: Path) -> None:
    before = os.times()
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"

    done = subprocess.run(
        ["sh", "scripts/site.sh"], cwd=repository, capture_output=True, text=True, check=False,
        env={**os.environ, "PATH": path, "http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"},
    )  # fmt: skip

    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 dead links, 0 requests to other hosts" in done.stdout
    after = os.times()
    used_s = sum(after[2:4]) - sum(before[2:4])  # of this process's children
    assert used_s < MAX_CPU_S
