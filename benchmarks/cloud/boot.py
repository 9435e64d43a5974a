"""Measure the start of a bare Debian machine until /readyz: pip on the machine against the ready archives.

    python -m benchmarks cloud.boot [--runs 3]

Needs root, debootstrap (once) and `make assets`.  S3 and the instance's metadata are emulated on this
machine, so the download takes no time of a network; both ways fetch the same libraries with all services of
maps.  The time begins when cloud-init would run the user data; CPU is that of the installation.  Defends: at
least 5x less time to /readyz.
"""

from __future__ import annotations

import re
import shutil
import statistics
import sys
import tempfile
import time
import zipfile
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import interleaved, spread

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY / "tests"))

from system.boot.world import World, debian_root, missing  # noqa: E402

from rse_pf.config import PlatformSettings  # noqa: E402
from rse_pf.config.resource_names import READY_PATH  # noqa: E402
from rse_pf.errors import ConfigurationError  # noqa: E402
from stacks.assets import SERVERS, SUMS_FILE, staged, sums_digest, sums_text  # noqa: E402

WAYS = ("pip", "archive")
BAR = 5.0
PIP_UNPACK = '''
def unpack(about):
    """Install the wheels as 0.1.0 did: by hash, without any index."""
    python = VENV / "bin" / "python"
    run("/usr/bin/python3", "-m", "venv", "--clear", "--without-pip", str(VENV))
    (pip,) = PACKAGE.glob("pip-*.whl")
    run(
        str(python), f"{pip}/pip", "install", "--quiet", "--no-index", "--no-deps", "--require-hashes",
        "--no-cache-dir", "--disable-pip-version-check", "--root-user-action=ignore",
        "--find-links", str(PACKAGE), "--requirement", str(PACKAGE / "requirements.txt"),
    )


'''


@benchmark(Bar("times_as_fast", at_least=BAR, unit="times"))
def run_benchmark(*, runs: Annotated[int, "starts of each way"] = 3) -> dict[str, Any]:
    """Start both ways alternately."""
    build = REPOSITORY / "build"
    problem = missing() or ("" if (build / SERVERS).is_dir() else "no packages in build: run make assets")
    if problem:
        raise ConfigurationError(problem, hint="see the help of this benchmark")
    root = debian_root(build / "debian12")
    taken: dict[str, list[tuple[float, float, float]]] = {way: [] for way in WAYS}
    for _, way in interleaved(WAYS, runs):
        taken[way].append(measure(way, build, root))
        say({"way": way, "ready_s": taken[way][-1][-1]})
    figures: dict[str, Any] = {
        way: {
            name: spread(values)
            for name, values in zip(("installed_s", "cpu_s", "ready_s"), zip(*rows, strict=True), strict=True)
        }
        for way, rows in taken.items()
    }
    ready = {way: statistics.median(row[-1] for row in rows) for way, rows in taken.items()}
    return {**figures, "times_as_fast": ready["pip"] / ready["archive"]}


def measure(way: str, build: Path, root: Path) -> tuple[float, float, float]:
    """Return the seconds until the package is installed, its seconds of CPU, and those until readiness."""
    settings = PlatformSettings()
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        package = staged(build, SERVERS, settings, folder)
        if way == "pip":
            use_pip(package, build)
        with World(folder, root) as world:
            world.boot(package, sums_digest(package))
            began_s = time.monotonic()
            world.wait(lambda: "user-data ended with" in world.text(), 600, "end of the boot")
            installed_s = time.monotonic() - began_s
            cpu_s = float(re.findall(r"([\d.]+) s of CPU", world.text())[0])
            port = settings.serving.control_port
            world.wait(lambda: world.status(port, READY_PATH) == 200, 300, "ready server")
            ready_s = time.monotonic() - began_s
        shutil.rmtree(world.root, ignore_errors=True)
    return installed_s, cpu_s, ready_s


def use_pip(package: Path, build: Path) -> None:
    """Replace the archives by wheels and a pip, and the unpacking by an installation."""
    import pip

    for archive in package.glob("*.tar.gz"):
        archive.unlink()
    for file in (build / "wheelhouse").iterdir():
        shutil.copyfile(file, package / file.name)
    assert pip.__file__
    source = Path(pip.__file__).parent
    with zipfile.ZipFile(package / f"pip-{pip.__version__}-py3-none-any.whl", "w") as wheel:
        for module in sorted(source.rglob("*")):
            if module.is_file() and module.suffix != ".pyc":
                wheel.write(module, f"pip/{module.relative_to(source).as_posix()}")
    script = package / "install.py"
    text = script.read_text(encoding="utf-8")
    script.write_text(text.replace('if __name__ == "__main__":', f'{PIP_UNPACK}if __name__ == "__main__":'))
    (package / SUMS_FILE).write_text(sums_text(package), encoding="utf-8")
