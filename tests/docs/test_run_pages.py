"""The pages as a reader follows them: sybil finds their blocks, which run in the order of the page.

Commands (a block without a language, or ``sh``) and programs (``python``) run, unless sybil's comment
``skip: next "REASON"`` stands before them.  The comment ``file: NAME`` names the file in which a program is
saved for the commands after it.

Every page has an empty folder, a home and a platform of its own, and a network namespace of its own where the
user may make one, so that the ports of the pages are free.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from unittest import SkipTest

import pytest
from sybil import Document, Example, Region, Sybil
from sybil.parsers.markdown import SkipParser
from sybil.parsers.markdown.lexers import DirectiveInHTMLCommentLexer, FencedCodeBlockLexer

from tests.kit.documentation_pages import PAGES, ROOT

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(400)]

SOON_S = 120.0
WHILE_A_PLATFORM_RUNS = (
    "docs/local.md", "docs/fleet_page.md", "docs/howto/robot_keys.md", "docs/howto/load_and_faults.md",
)  # fmt: skip
RUN_BY_OTHERS = ("docs/operations.md", "docs/howto/own_extension.md")
"""Pages whose blocks `tests/stacks/test_operations.py` and `tests/docs/test_own_extension.py` run."""
RUN_BY_CI = ("make demo", "make test", ". .venv/bin/activate", "cd ")
"""`.ci/run` executes them; here the environment is active already."""
EXECUTED_IN = {
    "rse-pf data --keys": "tests/cli/test_pages.py",
    "rse-pf map list": "tests/cli/test_pages.py",
    "rse-pf map show": "tests/cli/test_pages.py",
    "rse-pf map diff": "tests/cli/test_pages.py",
    "rse-pf map rollback": "tests/cli/test_pages.py",
    "rse-pf map prune": "tests/cli/test_pages.py",
    "rse-pf map export": "tests/cli/test_pages.py",
    "rse-pf map backup": "tests/cli/maps/test_map_backup.py",
    "rse-pf map restore": "tests/cli/maps/test_map_backup.py",
    "rse-pf robot adopt": "tests/cli/access/test_adopt.py",
    "rse-pf robot quota": "tests/cli/access/test_tenant.py",
    "rse-pf tenant quota": "tests/cli/access/test_tenant.py",
    "rse-pf tenant list": "tests/cli/access/test_tenant.py",
}
"""Commands that need a store or a robot with a past: another test makes it, and runs them."""
_START = re.compile(r"rse-pf local(?= --(?!lan)| *$)")
_READY, _PAGE = re.compile(r"wss?://\S+"), re.compile(r"fleet page +http\S+")
"""What a platform prints when robots can connect, and when its page serves, a little later."""


def parse_blocks(document: Document) -> Iterator[Region]:
    """Yield the blocks that run, and the names of the files in which programs are saved."""
    for region in DirectiveInHTMLCommentLexer(directive="file")(document):
        region.evaluator = name_file
        yield region
    for region in FencedCodeBlockLexer(language=r"\w*")(document):
        if region.lexemes["language"] in ("", "sh", "python"):
            region.evaluator = follow_block
            yield region


def name_file(example: Example) -> None:
    example.namespace["file"] = example.region.lexemes["arguments"]


def follow_block(example: Example) -> None:
    lexemes = example.region.lexemes
    example.namespace["follow"](
        str(lexemes["language"]), str(lexemes["source"]), example.namespace.pop("file", "")
    )


SYBIL = Sybil(parsers=[parse_blocks, SkipParser()])


def follow_page(page: str, follow: Callable[[str, str, str], None]) -> None:
    """Call *follow* with language, text and file of each block of *page* that is not skipped."""
    document = SYBIL.parse(ROOT / page)
    document.namespace["follow"] = follow
    for example in document.examples():
        with suppress(SkipTest):  # the page has the reason
            example.evaluate()


def blocks(page: str) -> list[tuple[str, str, str]]:
    """Return what `follow_page` would run."""
    found: list[tuple[str, str, str]] = []
    follow_page(page, lambda *block: found.append(block))
    return found


class Reader:
    """One reader of one page: a folder, a home, and the platforms that the page starts."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "examples").symlink_to(ROOT / "examples")
        binaries = str(Path(sys.executable).parent)
        self.environment = {
            **os.environ,
            "PATH": f"{binaries}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "PYTHONUNBUFFERED": "1",
            "XDG_STATE_HOME": str(folder / ".state"),
            "HOME": str(folder),
        }
        self._started: list[subprocess.Popen[str]] = []

    def start_platform(self, command: str) -> None:
        """Start a platform instead of the one that runs, and wait until it prints its addresses."""
        self.leave()
        process = subprocess.Popen(
            ["bash", "-c", f"exec {command}"], cwd=self.folder, env=self.environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        self._started.append(process)
        lines: Queue[str] = Queue()

        def read() -> None:
            assert process.stdout is not None
            with process.stdout:
                for line in process.stdout:
                    lines.put(line)
            lines.put("")

        threading.Thread(target=read, daemon=True).start()
        told = ""
        ready = _READY if "--no-page" in command else _PAGE
        while not ready.search(told):
            try:
                line = lines.get(timeout=SOON_S)
            except Empty:
                pytest.fail(f"{command} is not ready after {SOON_S:g} s: {told}")
            if not line:
                pytest.fail(f"{command} ended: {told}")
            told += line

    def run(self, script: str) -> str:
        """Run lines of a shell; return what they print."""
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", script], cwd=self.folder, env=self.environment, check=False,
            text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=SOON_S * 2,
        )  # fmt: skip
        assert done.returncode == 0, f"{script}\n{done.stdout}"
        return done.stdout

    def follow(self, language: str, text: str, file: str) -> None:
        """Do what a block says."""
        if language == "python":
            (self.folder / (file or "block.py")).write_text(text, encoding="utf-8")
            if not file:
                self.run("python block.py")
            return
        script = []
        for line in text.splitlines():
            if line.startswith((*RUN_BY_CI, *EXECUTED_IN)):
                continue
            if _START.match(line):
                self.run("\n".join(script))
                script = []
                self.start_platform(line.partition(" #")[0])
            elif line.endswith("--follow"):
                script.append(f"timeout --signal=INT 3 {line} || [ $? -eq 124 ]")
            else:
                script.append(line)
        self.run("\n".join(script))

    def leave(self) -> None:
        """End the platforms."""
        for process in self._started:
            process.send_signal(signal.SIGINT)
        for process in self._started:
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._started = []


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[Reader]:
    """A reader in an empty folder."""
    one = Reader(tmp_path)
    try:
        yield one
    finally:
        one.leave()


def may_have_a_network() -> bool:
    """Say whether this user may make a network namespace."""
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        return False
    tried = ["unshare", "--net", "ip", "link", "set", "lo", "up"]
    return subprocess.run(tried, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("page", [page for page in PAGES if page not in RUN_BY_OTHERS and blocks(page)])
def test_what_a_page_says_works(page: str, reader: Reader) -> None:
    if os.environ.get("RSE_PF_OWN_NETWORK") != "1" and may_have_a_network():
        one = f"{__file__}::test_what_a_page_says_works[{page}]"
        inner = f"ip link set lo up && exec {sys.executable} -m pytest -q -x -p no:cacheprovider '{one}'"
        done = subprocess.run(
            ["unshare", "--net", "sh", "-c", inner], cwd=ROOT, env={**os.environ, "RSE_PF_OWN_NETWORK": "1"},
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout
        return
    if page in WHILE_A_PLATFORM_RUNS:
        reader.start_platform("rse-pf local")
    follow_page(page, reader.follow)
