"""What is laid beside the packages, and what the template vouches for."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.fleet.agent import SERVICES
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.config.server_settings import server_settings
from rse_pf.errors import ConfigurationError
from rse_pf.scaling.health import DRAIN_S
from stacks.assets import ENVIRONMENT_FILE, SERVERS, SETTINGS_FILE, SUMS_FILE, staged, sums_digest


@pytest.fixture
def assets(tmp_path: Path) -> Path:
    """Packages with one file each."""
    for name in (SERVERS, "lambda"):
        (tmp_path / "build" / name).mkdir(parents=True)
        (tmp_path / "build" / name / "thing.tar.gz").write_bytes(b"archive")
    return tmp_path / "build"


def test_a_package_carries_the_merged_settings(assets: Path, tmp_path: Path) -> None:
    settings = PlatformSettings.from_dict({"scaling": {"busy_cpu_percent": 61.5}, "serving": {"workers": 3}})

    function = load_settings(staged(assets, "lambda", settings, tmp_path / "out") / SETTINGS_FILE)
    server = load_settings(staged(assets, SERVERS, settings, tmp_path / "out") / SETTINGS_FILE)

    assert function == settings
    assert server_settings(server) == server_settings(settings)
    assert server.serving.workers == 3


def test_the_same_input_gives_the_same_sums_and_another_setting_others(assets: Path, tmp_path: Path) -> None:
    def digest(folder: str, **groups: Any) -> str:
        return sums_digest(staged(assets, SERVERS, PlatformSettings.from_dict(groups), tmp_path / folder))

    assert digest("a") == digest("b")
    assert digest("a") != digest("c", serving={"workers": 3})
    assert digest("a") == digest(
        "d", scaling={"max_servers": 9}, cloud={"audit_days": 9, "allow_insecure": True}
    )


@pytest.mark.parametrize("damage", ["missing", "empty", "file"])
def test_a_package_that_cannot_be_read_is_one_line_and_a_hint(
    assets: Path, tmp_path: Path, damage: str
) -> None:
    folder = assets / SERVERS
    shutil.rmtree(folder)
    if damage == "empty":
        folder.mkdir()
    if damage == "file":
        folder.write_text("not a folder")

    with pytest.raises(ConfigurationError) as told:
        staged(assets, SERVERS, PlatformSettings(), tmp_path / "out")

    assert told.value.hint == "run make assets"
    assert "\n" not in told.value.message


@pytest.mark.parametrize("change", ["none", "older", "missing", "more"])
def test_packages_of_other_sources_are_refused(
    assets: Path, tmp_path: Path, sources: Mapping[str, str], change: str
) -> None:
    files = {name: text for name, text in sources.items() if name.startswith("rse_pf/")}
    if change == "older":
        files["rse_pf/config/settings.py"] += "# before\n"
    if change == "missing":
        del files["rse_pf/errors.py"]
    if change == "more":
        files["rse_pf/attic.py"] = ""
    digests = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in files.items()}
    (assets / SERVERS / ENVIRONMENT_FILE).write_text(json.dumps({"sources": digests}), encoding="utf-8")

    if change == "none":
        staged(assets, SERVERS, PlatformSettings(), tmp_path / "out")
        return
    with pytest.raises(ConfigurationError, match="other sources") as told:
        staged(assets, SERVERS, PlatformSettings(), tmp_path / "out")
    assert told.value.hint == "run make assets"


def test_the_template_vouches_for_the_package_it_names(assembly: Any) -> None:
    data = assembly.one("AWS::EC2::LaunchTemplate")["LaunchTemplateData"]
    (package,) = [path.parent for path in assembly.folder.glob(f"asset.*/{SUMS_FILE}")]

    script = json.dumps(data["UserData"])

    assert sums_digest(package) in script
    assert package.name.removeprefix("asset.") in script
    for name in ("rse-pf-drain", "keys.json", assembly.settings.cloud.region):
        assert name in script


def test_the_group_and_the_hook_are_those_that_an_instance_is_given(assembly: Any) -> None:
    assert assembly.one("AWS::AutoScaling::AutoScalingGroup")["AutoScalingGroupName"] == "rse-pf"
    hook = assembly.one("AWS::AutoScaling::LifecycleHook")
    assert hook["LifecycleHookName"] == "rse-pf-drain"
    assert hook["HeartbeatTimeout"] == DRAIN_S


def test_an_instance_may_complete_the_hook_of_its_own_group_only(assembly: Any) -> None:
    statements = [
        statement
        for policy in assembly.all("AWS::IAM::Policy")
        for statement in policy["PolicyDocument"]["Statement"]
        if statement["Action"] == "autoscaling:CompleteLifecycleAction"
    ]

    (statement,) = statements
    assert json.dumps(statement["Resource"]).rstrip('"}]').endswith(":autoScalingGroupName/rse-pf")


def test_the_same_tree_gives_the_same_archive_whatever_its_times_and_owners(
    repository: Path, tmp_path: Path
) -> None:
    builder = _builder(repository)
    digests = []
    for at, name in enumerate(("a", "b")):
        tree = tmp_path / name
        (tree / "bin").mkdir(parents=True)
        (tree / "bin" / "rse-pf").write_text("#!/opt/rse-pf/venv/bin/python\n")
        (tree / "bin" / "rse-pf").chmod(0o755 if at else 0o775)
        (tree / "bin" / "python").symlink_to("/usr/bin/python3")
        os.utime(tree / "bin" / "rse-pf", (1e9 + at, 1e9 + at))
        archive = tmp_path / f"{name}.tar.gz"
        builder._pack(tree, archive)
        digests.append(hashlib.sha256(archive.read_bytes()).hexdigest())

    assert digests[0] == digests[1]
    with tarfile.open(tmp_path / "a.tar.gz") as packed:
        entries = {entry.name: entry for entry in packed}
    assert entries["bin/rse-pf"].mode == 0o755
    assert entries["bin/python"].linkname == "/usr/bin/python3"
    assert {(entry.uid, entry.gid, entry.mtime) for entry in entries.values()} == {(0, 0, 315532800)}


def test_a_server_unpacks_what_the_builder_packs_where_it_was_compiled_for(repository: Path) -> None:
    from stacks.boot import install

    builder = _builder(repository)

    assert (*builder.LIBRARIES, builder.PLATFORM) == install.ARCHIVES
    assert builder.ENVIRONMENT == "/opt/rse-pf/venv"
    assert builder.ENVIRONMENT_FILE == ENVIRONMENT_FILE
    assert set(SERVICES) | {"s3"} <= set(builder.APIS), (
        "the agent calls a service whose description is missing"
    )


def _builder(repository: Path) -> Any:
    spec = importlib.util.spec_from_file_location("assets_builder", repository / "scripts" / "assets.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
