"""The front of the command line: quick help, two lines for every error, no traceback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rse_pf.cli.main import VERBS, main
from rse_pf.config import PlatformSettings
from tests.kit.removed_extensions import skip_if_removed

HELP_S = 0.3


def complaint(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, list[str]]:
    """Run a verb that fails; return its exit code and its two lines."""
    code = main(words)
    told = capsys.readouterr()
    assert told.out == ""
    lines = told.err.splitlines()
    assert len(lines) == 2, told.err
    assert lines[1].startswith("  hint: ")
    return code, lines


@pytest.fixture(autouse=True)
def _alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.mark.parametrize(
    ("words", "first", "hint"),
    [
        ("lcoal", "no verb 'lcoal'", "did you mean local?"),
        ("xyzzy", "no verb 'xyzzy'", "known are "),
        ("--settings a.json serve", "--settings comes before the verb", "rse-pf VERB OPTIONS"),
        ("serve --prot 1", "unknown option --prot", "did you mean --port?"),
        ("serve --prot=1", "unknown option --prot", "did you mean --port?"),
        ("serve --port one", "argument --port: invalid int value: 'one'", "rse-pf serve --help"),
        ("serve --port", "argument --port: expected one argument", "rse-pf serve --help"),
        ("serve --port 99999", "serving.port = 99999 is above 65535", "lower --port"),
        ("serve --emulated-cores -1", "serving.emulated_cores = -1", "raise --emulated-cores"),
        ("serve --log-level inf", "'inf' is not one of debug, info", "did you mean info?"),
        ("serve --keys none.json", "cannot read the keys none.json: No such file", "JWKS"),
        ("serve --keys .", "cannot read the keys .: Is a directory", "JWKS"),
        ("serve --keys empty", "this is not a key set", "check empty"),
        ("serve --announce none/a.json", "there is no folder", "--announce"),
        ("serve --server-id ", "'' is not a valid name of a server", "1 to 64"),
        ("serve", "there are no keys", "key set file"),
        ("serve --settings none.json", "cannot read none.json", "--settings"),
        ("serve --settings empty", "empty is not JSON", "correct the file"),
        ("local strat", "'strat' is not one of start, stop", "did you mean start?"),
        ("local --xyzzy", "unknown option --xyzzy", "rse-pf local start --help"),
        ("local --name ../x", "'../x' is no name for a platform", "1 to 32"),
        ("local --servers 0", "local.servers = 0 is below 1", "raise --servers"),
        ("local --port -1", "local.port = -1 is below 0", "raise --port"),
        ("local --settings open.json", "serving.host = 0.0.0.0 would open", "127.0.0.1"),
        ("token", "arguments are required", "rse-pf token --help"),
        ("token isue robot-1", "'isue' is not one of issue, inspect", "did you mean issue?"),
        ("token issue robot-1", "cannot read the key", "rse-pf local"),
        ("token issue robot-1 --key empty", "others may read the key empty", "chmod 600 empty"),
        (
            "token issue robot-1 --keys empty",
            "unknown option --keys",
            "--keys is an option of inspect, revoke",
        ),
        ("token inspect a.b.c", "this is not a token", "rse-pf token issue"),
        ("token inspect W10.W10.", "this is not a token", "rse-pf token issue"),
        ("token inspect a.b.c --ttl 3", "unknown option --ttl", "--ttl is an option of issue"),
        ("settings scalign", "no group named 'scalign'", "groups are serving"),
        ("settings --json --markdown", "not allowed with", "rse-pf settings --help"),
        ("map --out", "arguments are required: ACTION", "rse-pf map --help"),
        ("map --xyzzy", "unknown option --xyzzy", "rse-pf map --help"),
        ("check --xyzzy", "unknown option --xyzzy", "rse-pf check --help"),
        ("doctor now", "unrecognized arguments: now", "leave it out"),
        ("demo --rate 0", "--rate 0 is not within", "the paper's"),
        ("demo --rate nan", "--rate nan is not within", "the paper"),
        ("demo --robots 0", "--robots 0 is not within", "at least one robot"),
        ("demo --robots two", "argument --robots: invalid int value", "rse-pf demo --help"),
        ("demo --engine opencl", "'opencl' is not one of native, opencv", "did you mean opencv?"),
        ("demo --codec xml", "'xml' is not one of zlib, json, bin", "rse-pf demo --help"),
        ("demo --frames 0", "--frames 0 is not within", "80"),
        ("demo --seed -1", "--seed -1 is below 0", "0 or more"),
        ("demo --frontend wide", "'wide' is not one of standard, wide-baseline", "rse-pf demo --help"),
        ("demo --data none", "none", "TUM"),
        ("demo --xyzzy 3", "unknown option --xyzzy", "rse-pf demo --help"),
    ],
)
def test_a_wrong_call_is_two_lines_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: str, first: str, hint: str
) -> None:
    skip_if_removed(words)
    (tmp_path / "empty").touch(mode=0o644)
    open_door = {"context": {"rse-pf": {"serving": {"host": "0.0.0.0"}}}}
    (tmp_path / "open.json").write_text(json.dumps(open_door))

    code, lines = complaint(capsys, *words.split(" "))

    assert code == 2
    assert first in lines[0]
    assert hint in lines[1]


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself_with_an_example(capsys: pytest.CaptureFixture[str], verb: str) -> None:
    assert main([verb, "--help"]) == 0

    page = capsys.readouterr().out
    assert f"rse-pf {verb}" in page.partition("example")[2], "no example"
    assert "--settings FILE" in page
    assert max(map(len, page.splitlines())) <= 110


def test_an_error_of_the_system_is_two_lines_and_exit_code_1(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise PermissionError(13, "Permission denied", "somewhere")

    monkeypatch.setattr("rse_pf.cli.settings.setting_rows", fail)

    code, lines = complaint(capsys, "settings")
    assert code == 1
    assert "Permission denied: 'somewhere'" in lines[0]


def test_an_interrupt_is_exit_code_130_without_a_word(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("rse_pf.cli.settings.setting_rows", interrupt)

    assert main(["settings"]) == 130
    told = capsys.readouterr()
    assert told.out + told.err == ""


@pytest.mark.system
def test_the_front_page_is_quick_because_nothing_heavy_is_imported() -> None:
    program = "import sys; from rse_pf.cli.main import main; main(['--help']); print(*sys.modules, sep='\\n')"
    before = os.times().children_user
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    cpu_s = os.times().children_user - before

    loaded = {name.partition(".")[0] for name in told.stdout.splitlines()}
    assert not loaded & {"numpy", "msgspec", "websockets", "cryptography", "asyncio", "envoy", "cv2", "rich"}
    assert cpu_s < HELP_S


@pytest.mark.system
def test_a_reader_that_leaves_early_is_no_error() -> None:
    module = [sys.executable, "-m", "rse_pf.cli.main", "settings"]
    with subprocess.Popen(module, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


def test_settings_are_shown_with_what_the_file_changed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    chosen = {"context": {"rse-pf": {"scaling": {"max_servers": 4}}}}
    (tmp_path / "mine.json").write_text(json.dumps(chosen))

    assert main(["settings", "--settings", "mine.json"]) == 0
    text = capsys.readouterr().out
    assert "scaling.max_servers = 4 servers  (default 10)" in text
    assert text.count("\n    ") == sum(len(group) for group in PlatformSettings().to_dict().values())

    assert main(["settings", "--json", "--settings", "mine.json"]) == 0
    expected = PlatformSettings().replace(scaling={"max_servers": 4})
    assert json.loads(capsys.readouterr().out) == expected.to_dict()

    assert main(["settings", "digest", "--settings", "mine.json"]) == 0
    assert capsys.readouterr().out.strip() == expected.digest()


def test_the_page_of_settings_is_the_one_in_the_documentation(
    capsys: pytest.CaptureFixture[str], repository: Path
) -> None:
    assert main(["settings", "--markdown"]) == 0

    page = (repository / "docs" / "settings.md").read_text(encoding="utf-8")
    assert capsys.readouterr().out == page, "run make docs"


def test_a_verb_computes_with_one_thread_of_blas_whatever_the_environment_says() -> None:
    """With two threads, the last bits of a map differ from those of its map server."""
    script = """
import sys
from pathlib import Path
from rse_pf.cli.main import main
main(["errors", "E-NONE"])
assert "numpy" not in sys.modules
import numpy as np
np.ones((500, 500)) @ np.ones((500, 500))
print(len(list(Path("/proc/self/task").iterdir())))
"""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}

    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )

    assert done.stdout.split()[-1] == "1"
