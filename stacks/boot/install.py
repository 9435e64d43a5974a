#!/usr/bin/python3
"""Install a backend server on a plain Debian 12 machine; first_boot.py runs this file of the package as root.

Uses the standard library only.  Installs the wheels beside this file, by hash and without any index, into a
virtual environment, and starts the units.  A second run has the same result.  The server, its agent and the
data service run as a user who may write one folder.
"""

import json
import pathlib
import shutil
import subprocess
import sys

__all__ = ["environment_file", "main", "units_of"]

PACKAGE = pathlib.Path(__file__).resolve().parent
HOME = PACKAGE.parent
USER = "rse-pf"
UNITS = pathlib.Path("/etc/systemd/system")
CONFIGURATION = pathlib.Path("/etc/rse-pf")
ALWAYS = ("rse-pf.service", "rse-pf-agent.service")
DATA = "rse-pf-data.service"


def units_of(settings):
    """Return the units that start with the machine, for merged *settings* (group to names to values)."""
    return (*ALWAYS, DATA) if settings["data"]["enabled"] else ALWAYS


def environment_file(facts):
    """Return the environment file of the units: names of this server, its group and its buckets.

    *facts* holds ``server``, ``bucket``, ``keys``, ``group``, ``hook``, ``store`` and ``audit``.
    """
    names = {
        "SERVER_ID": "server", "BUCKET": "bucket", "KEYS_NAME": "keys", "GROUP": "group", "HOOK": "hook",
        "STORE": "store", "AUDIT_BUCKET": "audit",
    }  # fmt: skip
    for name in names.values():
        if not facts[name] or any(sign in facts[name] for sign in "\n\r\"'\\ $"):
            raise SystemExit(f"install: {name} = {facts[name]!r} is not a plain word")
    return "".join(f"{variable}={facts[name]}\n" for variable, name in names.items())


def main(facts):
    """Install everything; any failure ends the boot, and the group replaces the machine."""
    settings = json.loads((PACKAGE / "settings.json").read_text(encoding="utf-8"))["context"]["rse-pf"]
    if subprocess.run(["/usr/bin/id", USER], capture_output=True, check=False).returncode:
        run("/usr/sbin/useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", USER)
    python = HOME / "venv" / "bin" / "python"
    run("/usr/bin/python3", "-m", "venv", "--clear", "--without-pip", str(HOME / "venv"))
    (pip,) = PACKAGE.glob("pip-*.whl")
    run(
        str(python), f"{pip}/pip", "install", "--quiet", "--no-index", "--no-deps", "--require-hashes",
        "--no-cache-dir", "--disable-pip-version-check", "--root-user-action=ignore",
        "--find-links", str(PACKAGE), "--requirement", str(PACKAGE / "requirements.txt"),
    )  # fmt: skip
    CONFIGURATION.mkdir(exist_ok=True)
    (CONFIGURATION / "server.env").write_text(environment_file(facts), encoding="utf-8")
    started = units_of(settings)
    for unit in started:
        shutil.copyfile(PACKAGE / unit, UNITS / unit)
    run("/usr/bin/systemctl", "daemon-reload")
    run("/usr/bin/systemctl", "enable", "--now", *started)
    sys.stderr.write(f"install: started {' '.join(started)}\n")


def run(*command):
    """Run *command*; its output goes to the machine's console."""
    subprocess.run(command, check=True)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
