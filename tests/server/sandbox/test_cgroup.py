"""Cgroups of sandboxes: where they may be made, what they limit, and that nothing is left of them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rse_pf.server.sandbox.cgroup import Cgroups, Hierarchy, own_hierarchies

LIMITS = {"memory_bytes": 100 << 20, "max_threads": 8}
MIB = 1 << 20


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    """Return a machine without cgroups."""
    return Machine(tmp_path)


class Machine:
    """A process whose cgroups are plain folders."""

    def __init__(self, folder: Path) -> None:
        self.proc = folder / "proc"
        self.proc.mkdir()
        self._folder = folder
        self._lines: dict[str, list[str]] = {"cgroup": [], "mountinfo": []}

    def mount(self, version: int, controllers: str, path: str) -> Path:
        """Mount a hierarchy, put the process into cgroup *path* of it, and return the folder of that."""
        root = self._folder / (controllers or "unified")
        names, kind = (controllers, "cgroup") if version == 1 else ("", "cgroup2")
        self._lines["cgroup"].append(f"{len(self._lines['cgroup'])}:{names}:{path}")
        self._lines["mountinfo"].append(f"30 25 0:26 / {root} rw,relatime - {kind} {kind} rw,{names}")
        for name, lines in self._lines.items():
            (self.proc / name).write_text("\n".join(lines))
        place = root / path.lstrip("/")
        place.mkdir(parents=True)
        return place

    def mount_unified(self, path: str, controllers: str = "cpuset cpu io memory pids") -> Path:
        """Mount version 2, with a cgroup below the root, and return its folder."""
        place = self.mount(2, "", path)
        (place / "cgroup.controllers").write_text(controllers)
        (place / "cgroup.subtree_control").write_text("")
        (place / "cgroup.type").write_text("domain")
        (place / "cgroup.procs").write_text("4711")
        return place


def delegate(folder: Path) -> None:
    """Mark *folder* as systemd marks a cgroup with Delegate=yes."""
    try:
        os.setxattr(folder, "user.delegate", b"1")
    except OSError:
        pytest.skip("this file system keeps no attributes")


def test_cgroups_of_a_service_manager_are_left_alone(machine: Machine) -> None:
    machine.mount(1, "memory", "/jobs/7")
    machine.mount_unified("/user.slice/session-1.scope")

    assert own_hierarchies(machine.proc) == []


def test_a_delegated_cgroup_and_the_root_of_a_container_are_used(machine: Machine) -> None:
    unit = machine.mount_unified("/system.slice/rse-pf.service")
    delegate(unit)
    root = machine.mount(1, "pids", "/")
    machine.mount(1, "devices", "/")

    assert own_hierarchies(machine.proc) == [
        Hierarchy(unit, 2, ("memory", "pids", "cpu")), Hierarchy(root, 1, ("pids",)),
    ]  # fmt: skip


def test_a_process_that_was_moved_to_the_servers_cgroup_uses_the_one_above(machine: Machine) -> None:
    place = machine.mount(2, "", "/system.slice/rse-pf.service/rse-pf-server")
    (place.parent / "cgroup.controllers").write_text("memory pids")

    assert own_hierarchies(machine.proc) == [Hierarchy(place.parent, 2, ("memory", "pids"))]


def test_a_folder_that_is_not_delegated_keeps_its_processes(machine: Machine) -> None:
    container = machine.mount_unified("/")
    cgroups = Cgroups([Hierarchy(container, 2, ("memory", "pids"))], owner=1, **LIMITS)

    cgroups.prepare()

    assert cgroups.controllers == ()
    assert (container / "cgroup.subtree_control").read_text() == ""
    assert not (container / "rse-pf-server").exists()


def test_a_delegated_cgroup_gets_limits_for_each_sandbox(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    unit = machine.mount_unified("/system.slice/rse-pf.service")
    delegate(unit)
    monkeypatch.setattr(Path, "rmdir", shutil.rmtree)  # files of a real cgroup do not keep its folder
    cgroups = Cgroups(own_hierarchies(machine.proc), owner=12, **LIMITS)

    cgroups.prepare()
    assert cgroups.add(3, 4712)

    made = unit / "rse-pf-sandbox-12-3"
    assert cgroups.controllers == ("memory", "pids", "cpu")
    assert (unit / "rse-pf-server/cgroup.procs").read_text() == "4711"
    assert {file.name: file.read_text() for file in made.iterdir()} == {
        "memory.max": str(100 * MIB), "memory.swap.max": "0", "memory.oom.group": "1",
        "pids.max": "8", "cpu.weight": "100", "cgroup.procs": "4712",
    }  # fmt: skip
    (made / "memory.events").write_text("low 0\noom 1\noom_kill 1\n")
    assert cgroups.remove(3) == f"it used more than {100 * MIB} bytes of memory"
    assert not made.exists()


def test_version_1_limits_memory_with_and_without_swap(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = machine.mount(1, "memory", "/")
    monkeypatch.setattr(Path, "rmdir", shutil.rmtree)
    cgroups = Cgroups(own_hierarchies(machine.proc), owner=12, **LIMITS)

    cgroups.prepare()
    cgroups.add(3, 4712)

    made = root / "rse-pf-sandbox-12-3"
    assert {file.name: file.read_text() for file in made.iterdir()} == {
        "memory.limit_in_bytes": str(100 * MIB), "memory.memsw.limit_in_bytes": str(100 * MIB),
        "cgroup.procs": "4712",
    }  # fmt: skip
    assert cgroups.remove(3) == ""


def test_only_the_cgroups_of_servers_that_are_gone_are_removed(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    left, own, other = (
        tmp_path / name
        for name in (f"rse-pf-sandbox-{ended.pid}-1", f"rse-pf-sandbox-{os.getpid()}-1", "of-another-program")
    )
    for folder in (left, own, other):
        folder.mkdir()

    Cgroups([Hierarchy(tmp_path, 1, ("pids",))], owner=os.getpid(), **LIMITS).prepare()

    assert [folder.exists() for folder in (left, own, other)] == [False, True, True]


FORK_UNTIL_REFUSED = """
import os, signal
input()
children = []
try:
    while len(children) < 50:
        pid = os.fork()
        if pid == 0:
            signal.pause()
        children.append(pid)
except BlockingIOError:
    pass
for pid in children:
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
print(len(children))
"""


@pytest.mark.system
def test_the_kernel_refuses_more_processes_than_the_cgroup_may_have() -> None:
    hierarchies = [each for each in own_hierarchies() if "pids" in each.controllers]
    cgroups = Cgroups(hierarchies, owner=os.getpid(), **LIMITS)
    cgroups.prepare()
    if "pids" not in cgroups.controllers:
        pytest.skip("this process may not make cgroups")
    child = subprocess.Popen(
        [sys.executable, "-c", FORK_UNTIL_REFUSED], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert cgroups.add(1, child.pid)

        made, _ = child.communicate("\n")
    finally:
        child.kill()
        child.wait()

    assert int(made) == LIMITS["max_threads"] - 1
    assert cgroups.remove(1) == ""
    assert not any(hierarchies[0].folder.glob(f"rse-pf-sandbox-{os.getpid()}-*"))
