"""The C++ client: its own tests, with sanitizers, and a program that finds an installed copy."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]  # each test compiles Boost.Beast

CLIENT = Path(__file__).resolve().parents[2] / "client_cpp"
HEADERS = ("boost/beast/websocket.hpp", "nlohmann/json.hpp", "openssl/ssl.h")
MAX_STRIPPED_BYTES = 700_000
MAX_COMPILE_S = 60.0
CONSUMER = """\
cmake_minimum_required(VERSION 3.16)
project(Consumer CXX)
find_package(RsePf 1.0 REQUIRED)
add_executable(consumer consumer.cpp)
target_link_libraries(consumer PRIVATE RsePf::RsePf)
"""
PROGRAM = """\
#include <rse_pf/pnp.hpp>
int main() { return rse_pf::encoded(rse_pf::PnpRequest{}).empty() ? 1 : 0; }
"""


def run(*command: str | Path, seconds: float = 900.0) -> str:
    """Return what *command* prints; an error shows it."""
    done = subprocess.run(
        [str(each) for each in command], capture_output=True, text=True, timeout=seconds, check=False
    )
    assert done.returncode == 0, f"{command}: {done.stdout[-3000:]}{done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module", autouse=True)
def installed() -> None:
    """Skip without a compiler, CMake or a header, and say which."""
    missing = [program for program in ("c++", "cmake", "ctest", "strip") if shutil.which(program) is None]
    for header in HEADERS if not missing else ():
        found = subprocess.run(
            ["c++", "-E", "-x", "c++", "-"],
            input=f"#include <{header}>", capture_output=True, text=True, check=False,
        )  # fmt: skip
        missing += [] if found.returncode == 0 else [header]
    if missing:
        pytest.skip(f"without {', '.join(missing)}: sh scripts/client_cpp.sh names the packages")


def build(folder: Path, targets: Sequence[str], *options: str) -> None:
    """Compile *targets* of the client in *folder*."""
    run("cmake", "-S", CLIENT, "-B", folder, *options)
    run("cmake", "--build", folder, *(word for each in targets for word in ("--target", each)))


@pytest.mark.parametrize("sanitizer", ["address,undefined", "thread"])
def test_its_own_tests_hold_with_sanitizers(tmp_path: Path, sanitizer: str) -> None:
    build(tmp_path, ("rse_pf_session_test", "rse_pf_client_test"), f"-DRSE_PF_SANITIZE={sanitizer}")

    for program in ("rse_pf_session_test", "rse_pf_client_test"):
        assert "all hold" in run(tmp_path / program, seconds=120)


def test_a_program_is_small_and_compiles_in_a_minute(tmp_path: Path) -> None:
    run("cmake", "-S", CLIENT, "-B", tmp_path)
    before = os.times()
    build(tmp_path, ("rse_pf_first_pose",))
    after = os.times()
    compiled_s = after.children_user + after.children_system - before.children_user - before.children_system

    run("strip", tmp_path / "rse_pf_first_pose")

    assert (tmp_path / "rse_pf_first_pose").stat().st_size <= MAX_STRIPPED_BYTES
    assert compiled_s <= MAX_COMPILE_S


def test_an_installed_copy_is_found_by_another_build(tmp_path: Path) -> None:
    nothing_else = ("-DRSE_PF_BUILD_EXAMPLES=OFF", "-DRSE_PF_BUILD_TESTS=OFF")
    prefix = tmp_path / "usr"
    run("cmake", "-S", CLIENT, "-B", tmp_path / "build", *nothing_else, f"-DCMAKE_INSTALL_PREFIX={prefix}")
    run("cmake", "--install", tmp_path / "build")
    consumer = tmp_path / "consumer"
    consumer.mkdir()
    (consumer / "CMakeLists.txt").write_text(CONSUMER)
    (consumer / "consumer.cpp").write_text(PROGRAM)

    run("cmake", "-S", consumer, "-B", consumer / "build", f"-DCMAKE_PREFIX_PATH={prefix}")
    run("cmake", "--build", consumer / "build")

    run(consumer / "build" / "consumer")


def test_a_client_that_nobody_answers_gives_up_with_a_hint(tmp_path: Path) -> None:
    build(tmp_path, ("rse_pf_first_pose",))
    began = time.monotonic()

    done = subprocess.run(
        [tmp_path / "rse_pf_first_pose", "ws://127.0.0.1:1/ws"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip

    assert (done.returncode, done.stdout) == (1, "")
    assert "connect: cannot connect to 127.0.0.1:1" in done.stderr
    assert "hint:" in done.stderr
    assert time.monotonic() - began < 20


def test_a_platform_with_tls_is_trusted_by_its_authority_alone(tmp_path: Path) -> None:
    build(tmp_path, ("rse_pf_first_pose",))
    command = [sys.executable, "-m", "rse_pf.cli.main"]
    home = {**os.environ, "XDG_STATE_HOME": str(tmp_path)}
    platform = subprocess.Popen(
        [*command, "local", "--lan", "--port", "0", "--metrics-port", "0", "--servers", "1", "--no-data"],
        cwd=tmp_path, env=home, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        assert platform.stdout is not None
        said = ""
        for line in platform.stdout:
            said += line
            if "logs and state" in line:
                break
        if "hint: for example: --lan" in said:
            pytest.skip(f"this machine has no address: {said}")
        url = re.search(r"wss://\S+", said)
        authority = re.search(r"authority +(\S+)", said)
        assert url is not None, said
        assert authority is not None, said
        issued = subprocess.run(
            [*command, "token", "issue", "robot-1"],
            cwd=tmp_path, env=home, capture_output=True, text=True, check=True,
        )  # fmt: skip

        def pose(**trust: str) -> subprocess.CompletedProcess[str]:
            return subprocess.run(
                [tmp_path / "rse_pf_first_pose", url[0], issued.stdout.strip()],
                capture_output=True, text=True, timeout=60, check=False, env={**os.environ, **trust},
            )  # fmt: skip

        trusted, stranger = pose(SSL_CERT_FILE=authority[1]), pose()

        assert trusted.returncode == 0, trusted.stderr
        assert "ok, 27 inliers" in trusted.stdout
        assert (stranger.returncode, stranger.stdout) == (1, "")
        assert "the certificate is not trusted" in stranger.stderr
        assert "hint: name its authority in ca_file" in stranger.stderr
    finally:
        platform.terminate()
        platform.communicate(timeout=60)
