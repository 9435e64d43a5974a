"""Bad input of a synthesis is reported in one line with a hint, before anything is written."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rse_pf.errors import SettingsError

if shutil.which("node") is None:
    pytest.skip("the CDK needs Node.js", allow_module_level=True)
pytest.importorskip("aws_cdk", reason="run make setup")

NOT_PUBLIC = {"cloud": {"allow_insecure": False, "domain_name": "robots.example.org"}}
ENOUGH_S = 240


class Checkout:
    """A folder with app.py, a cdk.json of its own, and packages."""

    def __init__(self, folder: Path, repository: Path) -> None:
        self.folder = folder
        self.document = json.loads((repository / "cdk.json").read_text(encoding="utf-8"))
        shutil.copy(repository / "app.py", folder / "app.py")
        for name in ("servers", "lambda"):
            (folder / "build" / name).mkdir(parents=True)
            (folder / "build" / name / "package.txt").write_text(name, encoding="utf-8")
        self.overrides({})

    def overrides(self, settings: dict[str, Any]) -> None:
        self.document["context"]["rse-pf"] = settings
        self.document["app"] = f"{sys.executable} app.py"
        (self.folder / "cdk.json").write_text(json.dumps(self.document), encoding="utf-8")

    def run(self) -> int:
        """Run app.py in this process."""
        spec = importlib.util.spec_from_file_location("app_under_test", self.folder / "app.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        code: int = module.main()
        return code


@pytest.fixture
def checkout(tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch) -> Checkout:
    """A checkout that can be spoilt."""
    monkeypatch.chdir(tmp_path)
    return Checkout(tmp_path, repository)


def package(checkout: Checkout) -> Path:
    return checkout.folder / "build" / "servers"


def lost(checkout: Checkout) -> None:
    shutil.rmtree(package(checkout))


def a_file(checkout: Checkout) -> None:
    lost(checkout)
    package(checkout).write_text("no folder", encoding="utf-8")


def stale(checkout: Checkout) -> None:
    (package(checkout) / "rse_pf").mkdir()
    (package(checkout) / "rse_pf" / "errors.py").write_text("old", encoding="utf-8")


def torn(checkout: Checkout) -> None:
    (package(checkout) / "environment.json").write_text('{"sources": {"a', encoding="utf-8")


def rotten(checkout: Checkout) -> None:
    """JSON, and not what the builder writes."""
    (package(checkout) / "environment.json").write_text('["rse_pf"]', encoding="utf-8")


def settings(**groups: dict[str, Any]) -> Callable[[Checkout], None]:
    return lambda checkout: checkout.overrides(groups)


def no_json(checkout: Checkout) -> None:
    (checkout.folder / "cdk.json").write_text("{", encoding="utf-8")


def surroundings(repository: Path) -> dict[str, str]:
    """Return the environment of a subprocess: the wheel's Node first, no home of anybody."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {"PATH": path, "PYTHONPATH": str(repository)}


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (settings(scaling={"max_server": 4}), "unknown setting scaling.max_server"),
        (settings(skaling={}), "skaling"),
        (settings(scaling={"min_servers": 5, "max_servers": 4}), "scaling.max_servers = 4 is less than"),
        (settings(**NOT_PUBLIC), "cloud.allow_insecure = false needs cloud.certificate_arn"),
        (settings(cloud={"region": "mars-north-1"}), "cloud.region = 'mars-north-1'"),
        (settings(scaling={"max_servers": "many"}), "'many' is not of type int"),
        (no_json, "is not JSON"),
        (lost, "no packages in"),
        (a_file, "no packages in"),
        (stale, "were built of other sources"),
        (torn, "environment.json cannot be read: "),
        (rotten, "environment.json cannot be read: "),
    ],
)
def test_bad_input_is_one_line_and_a_hint(
    capsys: pytest.CaptureFixture[str], checkout: Checkout, spoil: Callable[[Checkout], None], words: str
) -> None:
    spoil(checkout)

    assert checkout.run() == 2

    first, second = capsys.readouterr().err.splitlines()
    assert words in first
    assert second.startswith("  hint: ")
    assert not (checkout.folder / "cdk.out").exists()


def test_a_synthesis_that_fails_is_one_line_and_a_hint(
    capsys: pytest.CaptureFixture[str], checkout: Checkout, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(app: object) -> None:
        raise RuntimeError("EROFS: read-only file system\n    at writeFileSync (node:fs)")

    monkeypatch.setattr("aws_cdk.App.synth", failing)

    assert checkout.run() == 2

    first, second = capsys.readouterr().err.splitlines()[-2:]
    assert first == "synthesis failed: EROFS: read-only file system"
    assert second.startswith("  hint: ")


@pytest.mark.parametrize("context", [{"max_servers": 4}, {"rse-pf": {"scaling": {"max_servers": 4}}}])
def test_context_of_the_command_line_is_refused(checkout: Checkout, context: dict[str, Any]) -> None:
    from app import check_context

    with pytest.raises(SettingsError) as told:
        check_context(context, checkout.document["context"])

    assert "is not used" in told.value.message


@pytest.mark.system
def test_python_app_py_says_it_without_a_traceback(checkout: Checkout, repository: Path) -> None:
    told = subprocess.run(
        [sys.executable, "app.py"], cwd=checkout.folder, capture_output=True, text=True, timeout=ENOUGH_S,
        env={**surroundings(repository), "CDK_CONTEXT_JSON": '{"max_servers": 4}'}, check=False,
    )  # fmt: skip

    assert told.returncode == 2
    assert told.stderr.startswith("SettingsError: context 'max_servers'")
    assert len(told.stderr.splitlines()) == 2


@pytest.mark.system
@pytest.mark.slow
def test_the_cdk_stops_at_it_and_synthesises_nothing(checkout: Checkout, repository: Path) -> None:
    cli = repository / "node_modules" / "aws-cdk" / "bin" / "cdk"
    node = shutil.which("node", path=surroundings(repository)["PATH"])
    if not cli.exists() or node is None:
        pytest.skip("the CDK's command line is not installed: make setup")
    checkout.overrides({"scaling": {"min_servers": 5, "max_servers": 4}})

    told = subprocess.run(
        [node, str(cli), "synth", "--quiet", "--no-notices"], cwd=checkout.folder, capture_output=True,
        text=True, timeout=ENOUGH_S, check=False,
        env={**surroundings(repository), "HOME": str(checkout.folder)},
    )  # fmt: skip

    assert told.returncode != 0
    assert "scaling.max_servers = 4 is less than scaling.min_servers = 5" in told.stderr
    assert "hint: raise scaling.max_servers" in told.stderr
    assert "Traceback" not in told.stderr
    assert not list(checkout.folder.glob("cdk.out/*.template.json"))
