"""bandit and detect-secrets find nothing that nobody has judged; what was judged is listed, with why.

bandit takes ten seconds of CPU: it runs with the slow tests, and ruff's edition of its rules by default.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import pytest
from detect_secrets.core.secrets_collection import SecretsCollection
from detect_secrets.plugins.aws import AWSKeyDetector
from detect_secrets.plugins.base import RegexBasedDetector
from detect_secrets.plugins.basic_auth import BasicAuthDetector
from detect_secrets.plugins.jwt import JwtTokenDetector
from detect_secrets.plugins.private_key import PrivateKeyDetector
from detect_secrets.settings import transient_settings

SOURCES = ("rse_pf", "client_sdk", "lambda_pnp", "stacks", "scripts", "app.py")

HARMLESS: Mapping[tuple[str, str], str] = {
    ("client_sdk/concurrency/user_callbacks.py", "B105"): "the name of a function in reports",
    ("lambda_pnp/keys.py", "B310"): "the address of the bucket, from the stack, always https",
    ("rse_pf/aws/fleet/instance.py", "B105"): "seconds that a metadata token lives",
    ("rse_pf/aws/fleet/instance.py", "B310"): "the instance's own metadata, a literal address",
    ("rse_pf/aws/lifecycle/leftovers.py", "B105"): "a sentence about the secret, not the secret",
    (
        "rse_pf/server/sandbox/isolation.py",
        "B108",
    ): "what an environment does not see; its own scratch folder",
    (
        "rse_pf/server/live_map/map_server/process.py",
        "B104",
    ): "an address that is read: the server found out which address of its machine others reach",
    ("rse_pf/cli/main.py", "B105"): "help of the verb named token",
    ("rse_pf/data_server/app.py", "B106"): "an empty default",
    ("rse_pf/local/control/operator_port.py", "B105"): "an empty default",
    ("stacks/boot/first_boot.py", "B310"): "the bucket and the instance's own metadata",
}
"""File and rule of bandit to why it is no weakness."""

NO_SECRETS: Mapping[tuple[str, str], str] = {
    (
        "client_sdk/network/http_proxy.py",
        "Basic Auth Credentials",
    ): "the words USER and PASSWORD of a hint",
    ("docs/local.md", "Basic Auth Credentials"): "the words USER and PASSWORD",
    ("docs/howto/own_certificates.md", "Secret Keyword"): "the name of a file",
    (
        "tests/client_sdk/test_http_proxy.py",
        "Basic Auth Credentials",
    ): "made up, for a proxy of the test",
    ("tests/hostile/test_floods.py", "Hex High Entropy String"): "digits of a long number",
    ("docs/protocol.md", "JSON Web Token"): "the page's example; its signature says 'signature'",
    ("docs/protocol.md", "Base64 High Entropy String"): "the same",
    ("rse_pf/aws/lifecycle/leftovers.py", "Secret Keyword"): "a sentence about the secret, not the secret",
    ("tests/aws/lifecycle/test_leftovers.py", "Secret Keyword"): "a name",
    (
        "tests/server/gateway/test_audit_recorder.py",
        "JSON Web Token",
    ): "made up, to be looked for in the audit log",
    ("client_cpp/tests/client_test.cpp", "Hex High Entropy String"): "the SHA-256 of 'abc', of FIPS 180-4",
    ("tests/audit/test_entry.py", "JSON Web Token"): "made up, to be looked for in the audit log",
    ("tests/config/test_settings.py", "Secret Keyword"): "the name of a file",
    ("tests/test_identity.py", "Base64 High Entropy String"): "the example of RFC 8037",
    ("tests/slam/test_place_recognition.py", "Hex High Entropy String"): "the digest of a vector",
    (
        "examples/robots/object_recognition_service/requests/photo.json",
        "Base64 High Entropy String",
    ): "a photo",
    ("tests/cli/local_platform/test_enrol.py", "Private Key"): "a heading without a key",
    ("tests/client_sdk/test_first_contact.py", "Secret Keyword"): "made up, to be hidden in an error",
    ("tests/maps/test_format.py", "Hex High Entropy String"): "the sha256 of a map",
    ("tests/aws/storage/test_key_store.py", "Secret Keyword"): "made for moto",
    ("tests/client_sdk/test_dial_errors.py", "Basic Auth Credentials"): "made up, to be hidden in an error",
    ("tests/cli/conftest.py", "Secret Keyword"): "made for moto",
    ("tests/lambda_pnp/test_keys.py", "Secret Keyword"): "made for moto",
    ("tests/lambda_pnp/test_day_budget.py", "Secret Keyword"): "made up, to be signed with",
    ("tests/config/test_server_settings.py", "Secret Keyword"): "the name of a file",
    ("tests/aws/canary/test_handler.py", "Secret Keyword"): "made for moto",
    ("tests/aws/canary/test_handler.py", "Hex High Entropy String"): "the example of W3C's Trace Context",
    ("rse_pf/aws/lifecycle/proof.py", "Secret Keyword"): "the name of a service",
    ("tests/kit/emulated_aws.py", "Secret Keyword"): "made for emulators",
    ("tests/client_sdk/test_burst_policy.py", "Basic Auth Credentials"): "made up, to be left out",
    ("tests/stacks/test_first_boot.py", "Secret Keyword"): "made for moto",
    ("tests/system/boot/imds.py", "Secret Keyword"): "made for moto",
    ("tests/recording/test_redact.py", "JSON Web Token"): "made up, to be kept out of a recording",
    ("tests/recording/test_redact.py", "Secret Keyword"): "the same",
    ("tests/recording/test_decoded_content.py", "JSON Web Token"): "the same",
    ("tests/recording/replay/test_case.py", "Secret Keyword"): "a name, to be kept out of a case",
    (
        "rse_pf/extensions/fleet_page/static/vendor/vendored.json",
        "Hex High Entropy String",
    ): "digests of the files",
    ("tests/storage/test_object_store.py", "Hex High Entropy String"): "the sha256 of 'abc'",
    ("tests/fixtures/expected_07e5efc6.json", "Hex High Entropy String"): "digests of maps and objects",
}
"""File and kind of detect-secrets to why it is none."""

_QUICK = (AWSKeyDetector, PrivateKeyDetector, JwtTokenDetector, BasicAuthDetector)
"""Patterns of a line; all plugins, which cost half a second a hundred files each, run with the slow tests."""


def weaknesses(repository: Path, files: Iterable[str]) -> set[tuple[str, str]]:
    """Return file and rule of what bandit finds in *files*, with the configuration of pyproject.toml."""
    settings = ["-c", str(repository / "pyproject.toml"), "-f", "json", "-q"]
    command = [sys.executable, "-m", "bandit", *settings, "-r", *files]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)
    report = json.loads(done.stdout)
    assert report["errors"] == []
    return {(each["filename"].removeprefix("./"), each["test_id"]) for each in report["results"]}


def weaknesses_by_ruff(repository: Path, files: Iterable[str]) -> set[tuple[str, str]]:
    """Return file and rule, as bandit calls it, of what ruff finds in *files* with the rules of bandit."""
    configuration = (repository / "pyproject.toml").read_text(encoding="utf-8")
    skipped = re.search(r"^skips = \[(.*)\]", configuration, re.M)
    assert skipped is not None
    ignored = ",".join(f"S{number}" for number in re.findall(r"B(\d+)", skipped[1]))
    options = ["--isolated", "--no-cache", "--select", "S", "--ignore", ignored, "--output-format", "json"]
    command = [sys.executable, "-m", "ruff", "check", *options, *files]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)
    names = ((Path(each["filename"]), each["code"]) for each in json.loads(done.stdout))
    return {
        (str(name.relative_to(repository) if name.is_relative_to(repository) else name), "B" + rule[1:])
        for name, rule in names
    }


def secrets(
    repository: Path, files: Iterable[str], *plugins: type[RegexBasedDetector]
) -> set[tuple[str, str]]:
    """Return file and kind of what detect-secrets finds in *files*: with *plugins*, or all it has."""
    configuration = json.loads((repository / ".secrets.baseline").read_text(encoding="utf-8"))
    if plugins:
        configuration["plugins_used"] = [{"name": plugin.__name__} for plugin in plugins]
        patterns = [pattern for plugin in plugins for pattern in plugin.denylist]
        files = [file for file in files if matches_a_line(repository / file, patterns)]
    found = set()
    with transient_settings(configuration):
        collection = SecretsCollection(root=str(repository))
        for file in files:
            collection.scan_file(file)
        for file, secret in collection:
            found.add((file, secret.type))
    return found


def matches_a_line(file: Path, patterns: Iterable[re.Pattern[str]]) -> bool:
    """Whether a plugin of *patterns* has anything to judge in *file*; twenty times as quick as the plugin."""
    text = file.read_text(encoding="utf-8", errors="replace")
    return any(pattern.search(line) for pattern in patterns for line in text.splitlines())


def text_files(repository: Path) -> list[str]:
    """Return what git tracks, but locks (hashes), golden messages and generated pages."""
    listed = subprocess.run(["git", "ls-files"], cwd=repository, capture_output=True, text=True, check=False)
    generated = ("locks/", "tests/wire/golden/", "docs/images/", "docs/results/", "fuzz/corpus/")
    return [
        file
        for file in listed.stdout.splitlines()
        if not file.startswith(generated) and not (file.startswith("docs/") and file.endswith(".json"))
    ]


@pytest.mark.parametrize(
    "search", [weaknesses_by_ruff, pytest.param(weaknesses, marks=pytest.mark.slow)], ids=["ruff", "bandit"]
)
def test_only_what_was_judged_is_found_and_a_shell_and_an_eval_are_seen(
    repository: Path, tmp_path: Path, search: Callable[[Path, Iterable[str]], set[tuple[str, str]]]
) -> None:
    file = tmp_path / "bad.py"
    file.write_text("import subprocess\nsubprocess.run(input(), shell=True)\neval(input())\n")

    found = search(repository, [*SOURCES, str(file)])

    assert {rule for name, rule in found if name == str(file)} == {"B602", "B307"}
    assert {each for each in found if each[0] != str(file)} <= HARMLESS.keys()


def test_no_key_lies_in_the_product_or_its_pages(repository: Path) -> None:
    files = [file for file in text_files(repository) if not file.startswith(("tests/", "benchmarks/"))]
    if not files:
        pytest.skip("not a git checkout, so the files that belong to it are unknown")

    assert secrets(repository, files, *_QUICK) <= NO_SECRETS.keys()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_no_secret_lies_anywhere_in_the_checkout(repository: Path) -> None:
    files = text_files(repository)
    if not files:
        pytest.skip("not a git checkout, so the files that belong to it are unknown")

    assert secrets(repository, files) <= NO_SECRETS.keys()


def test_a_key_would_be_seen(repository: Path, tmp_path: Path) -> None:
    file = tmp_path / "keys.py"
    file.write_text(
        "key = '" + "AKIA" + "Q3EGRWLEX5J2YEXW" + "'\n" + "-----BEGIN RSA " + "PRIVATE KEY-----\n"
    )

    for plugins in ((), _QUICK):
        found = {kind for _, kind in secrets(repository, [str(file)], *plugins)}
        assert found >= {"AWS Access Key", "Private Key"}


def unhashed(lock: str) -> list[str]:
    """Return the packages of a lock that are named without a hash."""
    entries = re.split(r"^(?=[a-zA-Z0-9])", lock, flags=re.M)
    return [each.split("==")[0] for each in entries if "==" in each and "--hash=sha256:" not in each]


def test_every_locked_package_has_a_hash(repository: Path) -> None:
    locks = (repository / "locks").iterdir()

    assert {file.name: unhashed(file.read_text(encoding="utf-8")) for file in locks} == {
        f"{name}.txt": [] for name in ("boot", "ci", "demo", "dev", "lambda", "localstack", "ros2", "tools")
    }
    assert "--require-hashes" in (repository / "scripts/setup.sh").read_text(encoding="utf-8")
    assert unhashed("a==1 \\\n    --hash=sha256:0\nb==2 ; python_version > '3'\n") == ["b"]
