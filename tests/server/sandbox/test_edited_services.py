"""Bytes whose hash was compared are the bytes that run: services that are edited under a running server."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId
from rse_pf.server.sandbox.manager import SandboxHost, SandboxManager
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.services.custom.cpp import INCLUDE_FOLDER
from rse_pf.services.custom.dependencies import Dependencies, platform_tag, tree_digest
from rse_pf.services.custom.installed import InstalledService, install, installed_services
from rse_pf.services.custom.verified_copy import PrivateFolder
from rse_pf.storage.object_store import MemoryStore
from rse_pf.wire import Command, Failure, Result

pytestmark = pytest.mark.system

PYTHON = """
import msgspec
from helper.number import NUMBER

class Request(msgspec.Struct): pass
class Reply(msgspec.Struct):
    number: float

def serve(request: Request) -> Reply:
    return Reply(number=NUMBER)
"""
PACKAGED = PYTHON.replace("helper.number", "packaged")
LUA = "return function(request) return {number = 1} end\n"
CPP = """
#include <rse_pf_service.h>
#include <stdlib.h>
#include <string.h>
uint32_t rse_pf_service_abi(void) { return RSE_PF_SERVICE_ABI; }
int rse_pf_service_open(const char *scratch, void **state) { (void)scratch; *state = NULL; return 0; }
int rse_pf_service_call(void *s, const uint8_t *r, uint64_t n, uint8_t **reply, uint64_t *size) {
  (void)s; (void)r; (void)n;
  *reply = malloc(64); memcpy(*reply, "{\\"number\\": NUMBER}", 13); *size = 13; return 0;
}
void rse_pf_service_free(void *s, void *memory) { (void)s; free(memory); }
"""
Ask = Callable[[str], Awaitable[Result | Failure]]


def write(folder: Path, language: str, number: int = 1) -> Path:
    """Write a service in *language* that replies with *number*, and return its folder."""
    made = folder / language
    entry = {"python": "service.py", "packaged": "service.py", "lua": "service.lua", "cpp": "service.so"}
    (made / "helper").mkdir(parents=True)
    manifest = {"name": language, "entry": entry[language]}
    manifest["language"] = "python" if language == "packaged" else language
    (made / "service.json").write_text(json.dumps(manifest))
    if language == "lua":
        (made / "service.lua").write_text(LUA.replace("1", str(number)))
    elif language == "cpp":
        source = made / "service.c"
        source.write_text(CPP.replace("NUMBER", str(number)))
        compiler = shutil.which("gcc") or pytest.skip("no gcc")
        command = [compiler, "-shared", "-fPIC", f"-I{INCLUDE_FOLDER}", "-o", str(made / "service.so")]
        subprocess.run([*command, str(source)], check=True)
    else:
        (made / "service.py").write_text(PACKAGED if language == "packaged" else PYTHON)
        (made / "helper" / "number.py").write_text(f"NUMBER = {number}\n")
    return made


def install_in(language: str, tmp_path: Path) -> list[InstalledService]:
    dependencies = None
    if language == "packaged":
        packages = tmp_path / "packages"
        packages.mkdir()
        (packages / "packaged.py").write_text("NUMBER = 1\n")
        digest = tree_digest(packages)
        dependencies = Dependencies(
            folder=packages, digest=digest, packages={"packaged": "1.0"}, platform=platform_tag()
        )
    install(write(tmp_path / "author", language), tmp_path / "services", dependencies)
    return installed_services(tmp_path / "services")


@asynccontextmanager
async def served(services: list[InstalledService]) -> AsyncIterator[tuple[Ask, list[str]]]:
    """Start the sandboxes of *services*; yield how to ask them, and what is logged."""
    lines: list[str] = []

    class Lines:
        def info(self, event: str, **fields: Any) -> None:
            lines.append(str(fields.get("text", "")))

        warning = error = info

    answers: dict[int, asyncio.Future[Result | Failure]] = {}
    loop = asyncio.get_running_loop()
    sandboxes = SandboxManager(
        services,
        settings=PlatformSettings.from_dict({"services": {"accept_weak_isolation": True}}),
        max_sandboxes=4,
        store=MemoryStore(),
        host=SandboxHost(
            server_id="test",
            loop=loop,
            monotonic=time.monotonic,
            log=Lines(),
            answer=lambda queued, answer: answers[queued.command.id].set_result(answer),
        ),
    ).start()

    async def ask(robot: str) -> Result | Failure:
        name, number = RobotId("fleet", robot), len(answers)
        sandboxes.add_connection(name)
        answers[number] = loop.create_future()
        now = time.monotonic()
        command = Command(id=number, service=services[0].name, payload={}, keep=True)
        sandboxes.submit(QueuedCommand(None, name, command, 0, now, now + 20))
        return await asyncio.wait_for(answers[number], 20)

    try:
        yield ask, lines
    finally:
        sandboxes.close()


def number_of(answer: Result | Failure) -> float:
    assert isinstance(answer, Result), answer
    reply: Any = answer.reply
    return float(reply["number"])


EDITS = [
    ("lua", "services/lua/service.lua", LUA.replace("1", "2").encode()),
    ("python", "services/python/service.py", PYTHON.replace("=NUMBER", "=2").encode()),
    ("python", "services/python/helper/number.py", b"NUMBER = 2\n"),
    ("packaged", "services/.dependencies/*/packaged.py", b"NUMBER = 2\n"),
    ("cpp", "services/cpp/service.so", None),
]


@pytest.mark.parametrize(("language", "path", "content"), EDITS)
async def test_a_service_that_is_edited_under_a_running_server_is_refused_in_the_next_sandbox(
    tmp_path: Path, language: str, path: str, content: bytes | None
) -> None:
    services = install_in(language, tmp_path)
    (file,) = tmp_path.glob(path)
    edited = (
        write(tmp_path / "other", "cpp", 2).joinpath("service.so").read_bytes()
        if content is None
        else content
    )

    async with served(services) as (ask, lines):
        assert number_of(await ask("before")) == 1
        file.chmod(0o644)
        file.write_bytes(edited)
        answer = await ask("after")
        assert isinstance(answer, Failure)
        assert (answer.code, "cannot be loaded" in answer.message) == ("internal", True)
        assert number_of(await ask("before")) == 1

    assert any("changed after it was installed" in line or "were changed" in line for line in lines), lines
    assert any("service install" in line for line in lines)


async def test_a_service_that_is_edited_before_a_sandbox_loads_it_is_not_loaded_from_there(
    tmp_path: Path,
) -> None:
    services = install_in("python", tmp_path)
    other = install(write(tmp_path / "author", "lua"), tmp_path / "services")
    services.append(other)

    async with served(services) as (ask, _):
        assert number_of(await ask("robot")) == 1
        services.reverse()
        (other.folder / "service.lua").write_text(LUA.replace("1", "2"))
        assert number_of(await ask("robot")) == 1  # the same sandbox loads it now, from the copy


@pytest.mark.parametrize("moment", ["before the zygote", "compiled"])
async def test_what_was_edited_after_the_comparison_never_runs(tmp_path: Path, moment: str) -> None:
    services = install_in("python", tmp_path)
    folder = services[0].folder
    if moment == "compiled":  # Python would take it for the source's, by the time and the size
        script = "import py_compile; py_compile.compile('helper/number.py', doraise=True)"
        about = (folder / "helper" / "number.py").stat()
        (folder / "helper" / "number.py").write_text("NUMBER = 2\n")
        os.utime(folder / "helper" / "number.py", ns=(about.st_atime_ns, about.st_mtime_ns))
        subprocess.run([shutil.which("python3") or "python3", "-c", script], cwd=folder, check=True)
        (folder / "helper" / "number.py").write_text("NUMBER = 1\n")
        os.utime(folder / "helper" / "number.py", ns=(about.st_atime_ns, about.st_mtime_ns))
    else:
        (folder / "helper" / "number.py").write_text("NUMBER = 2\n")

    async with served(services) as (ask, _):
        answer = await ask("robot")
        if moment == "compiled":
            assert number_of(answer) == 1
        else:
            assert isinstance(answer, Failure)


async def test_another_installation_in_its_place_waits_for_a_roll(tmp_path: Path) -> None:
    services = install_in("lua", tmp_path)

    async with served(services) as (ask, _):
        install(write(tmp_path / "newer", "lua", 2), tmp_path / "services")
        assert number_of(await ask("new")) == 1


async def test_a_service_whose_files_were_only_touched_runs(tmp_path: Path) -> None:
    services = install_in("lua", tmp_path)

    async with served(services) as (ask, _):
        (services[0].folder / "service.lua").touch()
        (services[0].folder / "service.lua").chmod(0o600)
        (services[0].folder / "service.lua").chmod(0o644)
        assert number_of(await ask("new")) == 1


async def test_the_copies_are_gone_after_the_end_and_those_of_a_killed_process_after_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    abandoned = Path(tempfile.mkdtemp(prefix="rse-pf-services-"))
    held = PrivateFolder(tmp_path / "temporary")
    kept = held.make()
    abandoned.mkdir(exist_ok=True)
    services = install_in("lua", tmp_path)

    async with served(services) as (ask, _):
        assert number_of(await ask("robot")) == 1
        assert len(list((tmp_path / "temporary").iterdir())) == 2

    assert list((tmp_path / "temporary").iterdir()) == [kept]
    held.remove()
    assert not kept.exists()
