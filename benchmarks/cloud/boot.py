"""Measure the start of a bare Debian machine until /readyz: pip on the machine against the ready archives.

    python -m benchmarks.cloud.boot [--runs 3]

Needs root, debootstrap (once) and `make assets`.  S3 and the instance's metadata are emulated on this
machine, so the download takes no time of a network; both ways fetch the same libraries with all services of
maps.  The time begins when cloud-init would run the user data; CPU is that of the installation.  Defends: at
least 5x less time to /readyz.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import statistics
import sys
import tempfile
import time
import zipfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY / "tests"))

from system.boot.world import World, debian_root, missing  # noqa: E402

from rse_pf.config import PlatformSettings  # noqa: E402
from rse_pf.config.resource_names import READY_PATH  # noqa: E402
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


def main() -> int:
    """Measure both ways alternately and print the medians; 1 when the bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=3, metavar="N", help="starts of each way")
    args = parser.parse_args()
    build = REPOSITORY / "build"
    problem = missing() or ("" if (build / SERVERS).is_dir() else "no packages in build: run make assets")
    if problem:
        sys.stderr.write(f"cannot measure: {problem}\n")
        return 2
    root = debian_root(build / "debian12")
    print(f"{platform.platform()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, n = {args.runs}")
    runs_of: dict[str, list[tuple[float, float, float]]] = {way: [] for way in WAYS}
    for _ in range(args.runs):
        for way in WAYS:
            runs_of[way].append(measure(way, build, root))
    ready = {}
    for way, runs in runs_of.items():
        installed_s, cpu_s, ready_s = (statistics.median(values) for values in zip(*runs, strict=True))
        ready[way] = ready_s
        worst_s = max(run_s for *_, run_s in runs)
        print(
            f"{way:8} installed {installed_s:6.1f} s ({cpu_s:.1f} s of CPU)   /readyz {ready_s:6.1f} s"
            f"   worst {worst_s:.1f} s"
        )
    times = ready["pip"] / ready["archive"]
    print(f"archive: {times:.1f}x less time to /readyz (bar {BAR:g}x)")
    return 0 if times >= BAR else 1


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


if __name__ == "__main__":
    sys.exit(main())
