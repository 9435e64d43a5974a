#!/usr/bin/python3
"""Install a backend server on a plain Debian 12 machine; first_boot.py runs this file of the package as root.

Uses the standard library only.  It unpacks the archives in the folder of this file, which first_boot.py has
verified, into a virtual environment, and starts the systemd units.  A second run has the same result.  The
server, its agent, the data service and the rosbridge server run as the user rse-pf, who may write only its
state folder and its folder in memory.
"""

import json
import pathlib
import shutil
import subprocess
import sys
import time

__all__ = ["environment_file", "main", "units_of"]

PACKAGE = pathlib.Path(__file__).resolve().parent
HOME = PACKAGE.parent
USER = "rse-pf"  # system user of all servers
UNITS = pathlib.Path("/etc/systemd/system")
CONFIGURATION = pathlib.Path("/etc/rse-pf")
VENV = HOME / "venv"
# The parts of the virtual environment, unpacked at the same time.
ARCHIVES = ("libraries-0.tar.gz", "libraries-1.tar.gz", "platform.tar.gz")
AGENT = "rse-pf-agent.service"
ALWAYS = ("rse-pf.service", AGENT)  # units that start whatever the settings say
DATA = "rse-pf-data.service"
ROSBRIDGE = "rse-pf-rosbridge.service"


def units_of(settings):
    """Return the systemd units to start, for *settings* (a dict of groups, each a dict of values by name).

    The data service and the rosbridge server are started only if the settings enable them.
    """
    data = (DATA,) if settings["data"]["enabled"] else ()
    return (*ALWAYS, *data, ROSBRIDGE) if settings["serving"]["rosbridge"] else (*ALWAYS, *data)


def environment_file(facts):
    """Return the text of the units' environment file, with a line VARIABLE=VALUE for each of eight *facts*.

    These are ``server``, ``bucket``, ``keys``, ``group``, ``hook``, ``launch``, ``store`` and ``audit``.
    Raise SystemExit if one of them is empty or has spaces, quotes or other special characters.
    """
    names = {
        "SERVER_ID": "server", "BUCKET": "bucket", "KEYS_NAME": "keys", "GROUP": "group", "HOOK": "hook",
        "LAUNCH_HOOK": "launch", "STORE": "store", "AUDIT_BUCKET": "audit",
    }  # fmt: skip
    for name in names.values():
        if not facts[name] or any(sign in facts[name] for sign in "\n\r\"'\\ $"):
            raise SystemExit(f"install: {name} = {facts[name]!r} is not a plain word")
    return "".join(f"{variable}={facts[name]}\n" for variable, name in names.items())


def main(facts):
    """Install and start everything; an error makes the boot fail, and the group replaces the machine."""
    settings = json.loads((PACKAGE / "settings.json").read_text(encoding="utf-8"))["context"]["rse-pf"]
    if subprocess.run(["/usr/bin/id", USER], capture_output=True, check=False).returncode:
        run("/usr/sbin/useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", USER)
    unpack(json.loads((PACKAGE / "environment.json").read_text(encoding="utf-8")))
    CONFIGURATION.mkdir(exist_ok=True)
    (CONFIGURATION / "server.env").write_text(environment_file(facts), encoding="utf-8")
    started = units_of(settings)
    for unit in started:
        shutil.copyfile(PACKAGE / unit, UNITS / unit)
    run("/usr/bin/systemctl", "daemon-reload")
    run("/usr/bin/systemctl", "enable", "--now", *started)
    sys.stderr.write(f"install: started {' '.join(started)}\n")


def unpack(about):
    """Unpack the archives into a new virtual environment, and compile bytecode unless they hold it.

    *about* is the content of environment.json.  Raise SystemExit if the archives are for another Python
    version than that of the machine.
    """
    if about["python"] != ".".join(map(str, sys.version_info[:2])):
        raise SystemExit(
            f"install: the environment is for Python {about['python']}, "
            f"the machine has {sys.version.split()[0]}: check cloud.image_parameter"
        )
    began_s = time.monotonic()
    shutil.rmtree(VENV, ignore_errors=True)
    VENV.mkdir(parents=True)
    tar = ("/usr/bin/tar", "--extract", "--gzip", "--no-same-owner", "--directory", str(VENV), "--file")
    for running in [subprocess.Popen([*tar, str(PACKAGE / name)]) for name in ARCHIVES]:
        if running.wait():
            raise SystemExit(f"install: {running.args[-1]} cannot be unpacked")
    if not about["bytecode"]:
        run(str(VENV / "bin/python"), "-m", "compileall", "-q", "-j", "0", str(VENV / "lib"))
    sys.stderr.write(f"install: unpacked the environment in {time.monotonic() - began_s:.1f} s\n")


def run(*command):
    """Run *command*, whose output goes to the log of the boot; raise CalledProcessError if it fails."""
    subprocess.run(command, check=True)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
