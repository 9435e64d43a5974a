"""What is published as the npm package: its size, its types, its names, and what the module never does."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.client_web.test_failures import node

REPOSITORY = Path(__file__).resolve().parents[2]
CLIENT = REPOSITORY / "client_web"
TOOLS = Path(__file__).resolve().parent / "tools"
MAX_BYTES = 12_000
MINIFY = ("--minify", "--mangle-props=^_", "--format=esm", "--target=es2022", "--tree-shaking=true")


@pytest.fixture(scope="module")
def tools(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the locked minifier and compiler."""
    npm = Path(sys.executable).with_name("npm")
    if not npm.exists():
        pytest.skip("no npm: make setup installs it")
    folder = tmp_path_factory.mktemp("tools")
    for name in ("package.json", "package-lock.json"):
        shutil.copy(TOOLS / name, folder)
    words = [str(npm), "ci", "--ignore-scripts", "--silent", "--no-audit", "--no-fund"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=240, check=False)
    if done.returncode != 0:
        pytest.skip("npm could not install esbuild and typescript: is the network there?")
    return folder / "node_modules" / ".bin"


@pytest.mark.slow
def test_the_minified_module_has_at_most_12_kb_and_decodes_every_golden_message(
    tools: Path, tmp_path: Path
) -> None:
    small = tmp_path / "rse-pf.min.mjs"
    words = [str(tools / "esbuild"), str(CLIENT / "rse-pf.js"), *MINIFY, f"--outfile={small}"]

    subprocess.run(words, check=True, capture_output=True, timeout=60)

    assert small.stat().st_size <= MAX_BYTES
    driver = REPOSITORY / "tests" / "clients" / "drivers" / "web_node.mjs"
    given = tmp_path / "input.json"
    given.write_text(json.dumps({"golden": str(REPOSITORY / "tests" / "wire" / "golden" / "messages.json")}))
    done = subprocess.run(
        [node(), str(driver), "golden"], capture_output=True, text=True, timeout=60, check=False,
        env={"RSE_PF_MODULE": str(small), "RSE_PF_INPUT": str(given)},
    )  # fmt: skip
    assert json.loads(done.stdout.splitlines()[-1])["event"] == "done", done.stdout + done.stderr


@pytest.mark.slow
def test_the_types_compile_with_a_program_that_uses_them(tools: Path, tmp_path: Path) -> None:
    (tmp_path / "rse-pf.d.ts").write_text((CLIENT / "rse-pf.d.ts").read_text("utf-8"))
    program = tmp_path / "program.ts"
    program.write_text(
        'import { connect, RsePfError, type PnpReply } from "./rse-pf.js";\n'
        'const robot = await connect("ws://127.0.0.1:8700/ws", { token: async () => "t" });\n'
        "const camera = { fx: 1, fy: 1, cx: 0, cy: 0, width: 2, height: 2 };\n"
        "const request = { camera, pointsWorld: new Float64Array(12), pixels: [1, 2, 3, 4, 5, 6, 7, 8] };\n"
        "const pose: PnpReply = (await robot.solvePnp(request)).reply;\n"
        "const end: () => void = robot.subscribe('live/a', (key: string, payload) => payload.kind);\n"
        "try { await robot.call('x', {}, { signal: AbortSignal.timeout(5) }); }\n"
        "catch (error) { if (error instanceof RsePfError) end(); else throw pose.verdict; }\n"
    )
    words = [str(tools / "tsc"), "--strict", "--noEmit", "--module", "esnext", "--target", "es2022"]
    words += ["--moduleResolution", "bundler", "--lib", "es2022,dom", str(program)]

    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)

    assert (done.returncode, done.stdout) == (0, "")
    program.write_text(program.read_text() + "const wrong: number = robot.server;\n")
    wrong = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert wrong.returncode != 0
