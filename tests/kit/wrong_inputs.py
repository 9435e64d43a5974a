"""The wrong inputs of the command line, as a table; tests/cli/words/test_wrong_inputs.py runs them.

Each row is what a user typed, the exit code, words of the line that says what is wrong, and words of the hint
that says what to do.  The files that rows name are made by `make_files`.
"""

# ruff: noqa: E501  a table: one row, one line

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rse_pf.geometry import Camera
from rse_pf.local.firewall import ensure_key
from rse_pf.maps.format import Keyframe, MapVersion, encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore

__all__ = ["FAILED", "USAGE", "WRONG_INPUTS", "WrongInput", "make_files"]

FAILED, USAGE = 1, 2


@dataclass(frozen=True, slots=True)
class WrongInput:
    """What was typed, and what the answer must hold."""

    typed: str
    code: int
    says: str
    hint: str


def make_files(folder: Path) -> None:
    """Write the files that the rows name into *folder*, and a platform that is not running to its state."""
    for name, settings in _SETTINGS.items():
        (folder / name).write_text(json.dumps({"context": {"rse-pf": settings}}), encoding="utf-8")
    for name, text in _TEXTS.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "open.key").chmod(0o644)
    for name in ("nothing", "new-service", "rec-empty", "rec-unpaired", "rec-words"):
        (folder / name).mkdir(exist_ok=True)
    state = folder / "state" / "rse-pf" / "default"
    state.mkdir(parents=True)
    (state.parent / "a-folder-of-maps" / "objects").mkdir(parents=True)
    ensure_key(state, seed=b"s" * 32, key_id="k")
    maps = MapRegistry(DirectoryStore(folder / "store"))
    maps.commit("hall", _map(2), parent=None, author="a test", created_s=1.0)


_SETTINGS: dict[str, dict[str, object]] = {
    "open.json": {"serving": {"host": "0.0.0.0"}},
    "misspelt.json": {"scaling": {"min_server": 1}},
    "no-group.json": {"scalling": {"min_servers": 1}},
    "text.json": {"scaling": {"min_servers": "two"}},
    "crossed.json": {"scaling": {"min_servers": 9, "max_servers": 3}},
    "range.json": {"scaling": {"busy_cpu_percent": 900}},
}
_TEXTS = {
    "empty": "",
    "broken.json": "{",
    "fleet.json": '{"robot": 5}',
    "fleets.json": '{"robots": "five"}',
    "open.key": "{}",
    "picture.png": "no picture",
    "recording.zip": "no recording",
    "results/notes.txt": "mine",
    "rec-empty/rgb.txt": "# timestamp filename\n",
    "rec-empty/depth.txt": "# timestamp filename\n",
    "rec-unpaired/rgb.txt": "1.0 rgb/1.png\n",
    "rec-unpaired/depth.txt": "2.0 depth/1.png\n",
    "rec-words/rgb.txt": "first rgb/1.png\n",
    "rec-words/depth.txt": "1.0 depth/1.png\n",
    "unfinished.py": "def features(image):\n    return (\n",
    "typing.toml": "[frontend]\nfeature = 500\n",
    "bare/service.py": "",
    "odd/service.json": '{"name": "odd", "language": "cobol", "entry": "a.cob", "kind": "stateless"}',
    "broken-service/service.json": "{",
    "unasked/service.json": '{"name": "unasked", "language": "lua", "entry": "s.lua", "kind": "stateless"}',
    "unasked/s.lua": "return function(request) return request end",
    "audit/control-plane.jsonl": "no entry\n",
}


def _map(keyframes: int) -> bytes:
    camera = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
    frames = tuple(
        Keyframe(
            id=n, robot="robot-1", timestamp_s=float(n), T_world_camera=np.eye(4), camera=camera,
            pixels=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 32), np.uint8),
            points_camera=np.zeros((0, 3), np.float32),
        )
        for n in range(keyframes)
    )  # fmt: skip
    points = np.zeros((5, 3), np.float32)
    return encode_map(MapVersion(keyframes=frames, points=points, colours=np.zeros((5, 3), np.uint8)))


WRONG_INPUTS: tuple[WrongInput, ...] = (
    WrongInput("maps", USAGE, "no verb 'maps'", "did you mean map?"),
    WrongInput("xyzzy", USAGE, "no verb 'xyzzy'", "known are "),
    WrongInput("--out x demo", USAGE, "--out comes before the verb", "rse-pf VERB OPTIONS"),
    WrongInput("local --name x stop", USAGE, "stop is an action, and comes before the options", "rse-pf local stop, then"),
    WrongInput("robot --cloud list", USAGE, "unknown option --cloud", "--cloud is an option of "),
    WrongInput("robot list --name x", USAGE, "there is no platform 'x'", "known: default"),
    WrongInput("check", USAGE, "arguments are required: SOURCE", "rse-pf check --help"),
    WrongInput("check typo", USAGE, "typo does not exist", "a folder or a recording that exists"),
    WrongInput("check rec-empty", USAGE, "rec-empty/rgb.txt lists no image", "a line for each image"),
    WrongInput("check rec-empty --frames 1", USAGE, "--frames 1 is below 2", "leave it out"),
    WrongInput("check rec-empty --write nowhere/a.json", USAGE, "there is no folder", "create it"),
    WrongInput("compare", USAGE, "arguments are required: --data", "rse-pf compare --help"),
    WrongInput("compare --data typo", USAGE, "typo does not exist", "rgb.txt, depth.txt"),
    WrongInput("compare --data world:three", USAGE, "world:three names no rendered world", "world:3"),
    WrongInput("compare defualt --data world:3", USAGE, "no configuration 'defualt'", "did you mean default?"),
    WrongInput("compare default default --data world:3", USAGE, "two configurations are called default", "name each once"),
    WrongInput("compare features-3 --data world:3", USAGE, "features-3: 3 features are not within", "1000 is the default"),
    WrongInput("compare mine.py --data world:3", USAGE, "no file mine.py", "NAME.toml or NAME.py"),
    WrongInput("compare unfinished.py --data world:3", USAGE, "unfinished.py, line 2: SyntaxError", "python unfinished.py"),
    WrongInput("compare typing.toml --data world:3", USAGE, "typing.toml: frontend has no option feature", "did you mean features?"),
    WrongInput("compare --data world:3 --runs 0", USAGE, "--runs 0 is not within 1..100", "3 show a spread"),
    WrongInput("compare --data world:3 --rate 0", USAGE, "--rate 0 is not within 0.1..1000 Hz", "play all frames"),
    WrongInput("compare --data world:3 --out empty", USAGE, "cannot write empty", "another --out"),
    WrongInput("demo --robots 0", USAGE, "--robots 0 is not within 1..32", "at least one robot"),
    WrongInput("demo --robots 33", USAGE, "--robots 33 is not within 1..32", "fewer robots"),
    WrongInput("demo --robots two", USAGE, "--robots: invalid int value: 'two'", "rse-pf demo --help"),
    WrongInput("demo --rate nan", USAGE, "--rate nan is not within", "5 is the paper's"),
    WrongInput("demo --frames 5 --data rec-empty", USAGE, "--frames is for the rendered world", "with --rate"),
    WrongInput("demo --live --merge", USAGE, "--live and --merge exclude each other", "needs no merge"),
    WrongInput("demo --data typo", USAGE, "typo does not exist", "rgb.txt, depth.txt"),
    WrongInput("demo --data recording.zip", USAGE, "recording.zip is not a recording", "mapped by rse-pf map from-camera"),
    WrongInput("demo --data nothing", USAGE, "no rgb.txt in nothing", "TUM layout"),
    WrongInput("demo --data rec-empty", USAGE, "rec-empty/rgb.txt lists no image", "a line for each image"),
    WrongInput("demo --data rec-unpaired", USAGE, "no colour image of rec-unpaired has a depth image within 0.02 s", "same clock"),
    WrongInput("demo --data rec-words", USAGE, "rec-words/rgb.txt, line 1 has not 2 words", "timestamp filename"),
    WrongInput("demo --frontend wide", USAGE, "'wide' is not one of standard, wide-baseline", "--help"),
    WrongInput("demo --out results", USAGE, "results holds other files", "an empty folder"),
    WrongInput("demo --out empty", USAGE, "empty is a file", "--out"),
    WrongInput("experiment latencies", USAGE, "'latencies' is not one of latency", "did you mean latency?"),
    WrongInput("experiment latency --robots 0", USAGE, "--robots 0 is not within 1..2000", "100"),
    WrongInput("experiment latency --link lan", USAGE, "no link named 'lan'", "none, paper, wifi-bad, lte"),
    WrongInput("experiment latency --seconds inf", USAGE, "--seconds inf is not within", "30 is enough"),
    WrongInput("experiment elasticity --speed 0.5", USAGE, "--speed 0.5 is not within 1..100", "1 takes as long as the paper"),
    WrongInput("experiment robustness --only kill,sleep", USAGE, "there is no fault 'sleep'", "known are kill"),
    WrongInput("experiment verify", USAGE, "verify needs a folder", "rse-pf experiment verify DIR"),
    WrongInput("experiment verify typo", USAGE, "cannot read typo/report.json: No such file", "--out of an experiment"),
    WrongInput("experiment elasticity --speed nan", USAGE, "--speed nan", "1 takes as long as the paper; 30 suits CI"),
    WrongInput("experiment elasticity --fps inf", USAGE, "--fps inf", "the paper uses 5"),
    WrongInput("experiment elasticity --emulated-cores 0", USAGE, "--emulated-cores 0", "leave it out to measure it"),
    WrongInput("experiment live --only kill,balancer", USAGE, "there is no fault 'balancer'", "known are none, kill, stop, drain"),
    WrongInput("experiment robustness --repeat 0", USAGE, "--repeat 0", "3 shows the spread"),
    WrongInput("experiment map --robots 33", USAGE, "--robots 33 is not within 1..32", "the paper uses 100"),
    WrongInput("experiment latency somewhere", USAGE, "latency takes no folder", "name the results with --out somewhere"),
    WrongInput("experiment map --rerun", USAGE, "--rerun is for verify", "rse-pf experiment verify DIR --rerun"),
    WrongInput("experiment elasticity --robots 0", USAGE, "--robots 0 is not within 1..2000", "the paper uses 100"),
    WrongInput("local strat", USAGE, "'strat' is not one of start, stop", "did you mean start?"),
    WrongInput("local --servers 0", USAGE, "local.servers = 0 is below 1", "raise --servers"),
    WrongInput("local --port 70000", USAGE, "local.port = 70000 is above 65535", "lower --port"),
    WrongInput("local --name ../x", USAGE, "'../x' is no name for a platform", "small letters"),
    WrongInput("local --settings open.json", USAGE, "serving.host = 0.0.0.0 would open the local platform", "127.0.0.1"),
    WrongInput("local --record open.json", USAGE, "open.json is a file, not a folder", "name a folder"),
    WrongInput("local --record /proc/1/x", USAGE, "cannot write recordings to /proc/1/x", "that this user can write to"),
    WrongInput("swarm --record open.json", USAGE, "open.json is a file, not a folder", "name a folder"),
    WrongInput("swarm --name default --record r", USAGE, "no platform 'default' is running", "rse-pf local"),
    WrongInput("local kill", USAGE, "arguments are required: SERVER", "rse-pf local kill --help"),
    WrongInput("local status", USAGE, "platform 'default' is not running", "rse-pf local"),
    WrongInput("local stop --for 2", USAGE, "unknown option --for", "--for is an option of pause, slow, partition"),
    WrongInput("local --services typo", USAGE, "there is no services folder", "rse-pf service install FOLDER"),
    WrongInput("local logs server-1", USAGE, "unrecognized arguments: server-1", "leave it out"),
    WrongInput("local roll server-1", USAGE, "unrecognized arguments: server-1", "leave it out"),
    WrongInput("local drain", USAGE, "arguments are required: SERVER", "rse-pf local drain --help"),
    WrongInput("local logs --since soon", USAGE, "--since 'soon' is neither an age nor a time", "write an age such as 90s, 5m, 2h or 1d"),
    WrongInput("local status --since 5m", USAGE, "unknown option --since", "--since is an option of logs, events"),
    WrongInput("local roll --settings range.json", USAGE, "scaling.busy_cpu_percent = 900.0 is above 100", "lower it in cdk.json"),
    WrongInput("map list --name nowhere", USAGE, "there is no platform 'nowhere' on this machine", "known: a-folder-of-maps, default"),
    WrongInput("local status --follow", USAGE, "unknown option --follow", "--follow is an option of logs, events"),
    WrongInput("local status --lan 10.1.2.3", USAGE, "unknown option --lan", "--lan is an option of start"),
    WrongInput("local --lan status", USAGE, "--lan status is not an address", "for example: --lan 192.168.1.20; ip"),
    WrongInput("local status --burst", USAGE, "unknown option --burst", "--burst is an option of start"),
    WrongInput("local --burst 70000", USAGE, "--burst 70000 is not a port", "name one from 1 to 65535, or leave it out"),
    WrongInput("local --burst -1", USAGE, "--burst -1 is not a port", "name one from 1 to 65535, or leave it out"),
    WrongInput("local --lan 127.0.0.1", USAGE, "no address that another machine can connect to", "for example: --lan 192.168.1.20; ip"),
    WrongInput("local --settings range.json status", USAGE, "scaling.busy_cpu_percent = 900.0 is above 100", "lower it in cdk.json"),
    WrongInput("local robots", USAGE, "is not running", "start it with: rse-pf local"),
    WrongInput("local roll", USAGE, "is not running", "start it with: rse-pf local"),
    WrongInput("local logs", USAGE, "no logs in", "start a platform with rse-pf local, or"),
    WrongInput("fleet --name nobody", USAGE, "no fleet page runs for platform 'nobody'", "rse-pf local --name nobody"),
    WrongInput("fleet --name ..", USAGE, "'..' is no name for a platform", "small letters"),
    WrongInput("fleet --port 1", USAGE, "--port is for --cloud", "local.page_port"),
    WrongInput("fleet --cloud --operate", USAGE, "--operate is for a local platform", "docs/operations.md"),
    WrongInput("fleet --cloud --port 99999", USAGE, "--port 99999 is not within 0..65535", "0 takes a free one"),
    WrongInput("fleet --kill", USAGE, "unknown option --kill", "rse-pf fleet --help"),
    WrongInput("swarm --robots 0", USAGE, "robots = 0 is not within 1..10000", "from 1 to 10000"),
    WrongInput("swarm --scenario typo", USAGE, "cannot read typo", "name the file of a scenario"),
    WrongInput("swarm --scenario broken.json", USAGE, "broken.json is no scenario", "scenario.json"),
    WrongInput("swarm --scenario fleet.json", USAGE, "a scenario has no 'robot'", "it has robots, fps"),
    WrongInput("swarm --scenario fleets.json", USAGE, "Expected `int`, got `str` - at `$.robots`", "scenario.json"),
    WrongInput("swarm --fps nan", USAGE, "fps = nan is not within", "from 0.01 to 200"),
    WrongInput("swarm --codec xml", USAGE, "no codec named 'xml'", "zlib, json, bin"),
    WrongInput("swarm --servers 0", USAGE, "local.servers = 0 is below 1", "raise --servers"),
    WrongInput("swarm --name default", USAGE, "no platform 'default' is running", "rse-pf local --name default"),
    WrongInput("swarm --url http://127.0.0.1:8700 --token-from default", USAGE, "is not a WebSocket address", "ws://HOST:PORT/ws"),
    WrongInput("swarm --url ws://127.0.0.1:8700/ws", USAGE, "--url needs --token-from", "name a local platform"),
    WrongInput("swarm --quiet --url ws://127.0.0.1:9/ws --token-from default", FAILED, "cannot connect to ws://127.0.0.1:9/ws", "start the platform by rse-pf local start"),
    WrongInput("swarm --out results", USAGE, "results holds other files", "an empty folder"),
    WrongInput("camera calibrat", USAGE, "'calibrat' is not one of calibrate, board, check", "did you mean calibrate?"),
    WrongInput("camera calibrate", USAGE, "arguments are required: SOURCE", "rse-pf camera calibrate --help"),
    WrongInput("camera check typo", USAGE, "typo does not exist", "name a device by its number"),
    WrongInput("camera calibrate typo.png", USAGE, "typo.png does not exist", "name a device by its number"),
    WrongInput("camera calibrate drive.bag", USAGE, "drive.bag states its own calibration", "use rse-pf map from-bag drive.bag"),
    WrongInput("camera calibrate a.png b.png", USAGE, "a.png does not exist", "name a device by its number"),
    WrongInput("camera calibrate 97", USAGE, "camera 97 cannot be opened: /dev/video97 does not exist", "ls /dev/video*"),
    WrongInput("camera calibrate 0 --board nine", USAGE, "nine is not the size of a board", "count inner corners, such as 9x6"),
    WrongInput("camera calibrate 0 --board 2x2", USAGE, "2x2 corners is not within 3..40", "use 9x6"),
    WrongInput("camera calibrate 0 --square-mm 0", USAGE, "squares of 0 mm", "measure one printed square, in millimetres"),
    WrongInput("camera calibrate 0 --max-rms-px 0", USAGE, "--max-rms-px 0 is not above 0", "good cameras reach 0.5"),
    WrongInput("camera calibrate 0 --out typo/i.json", USAGE, "there is no folder", "create it"),
    WrongInput("camera board --out b.jpg", USAGE, "is no .pdf", "write board.pdf: it prints at its true size"),
    WrongInput("camera check 0 --frames 1", USAGE, "--frames 1 is below 2", "60 is two seconds of a webcam"),
    WrongInput("token isue robot-1", USAGE, "'isue' is not one of issue", "did you mean issue?"),
    WrongInput("token --ttl 600 issue", USAGE, "--ttl comes before the action", "rse-pf token ACTION, then the options"),
    WrongInput("token issue", USAGE, "arguments are required: ROBOT", "rse-pf token issue --help"),
    WrongInput("token issue robot-1 --ttl 1e9", USAGE, "a time to live of 1e+09 s is not within 900 s", "auth.token_ttl_s"),
    WrongInput("token issue robot-1 --name other", USAGE, "cannot read the key", "start a platform with rse-pf local"),
    WrongInput("token issue robot-1 --ttl 0", USAGE, "a time to live of 0 s is not within 900 s", "give 1 to 900 s"),
    WrongInput("token issue robot-1 --scope everything", USAGE, "'everything' is not a scope", "services:NAME"),
    WrongInput("token issue robot-1 --key open.key", USAGE, "others may read the key open.key", "chmod 600 open.key"),
    WrongInput("token inspect abc", USAGE, "this is not a token", "rse-pf token issue"),
    WrongInput("token revoke", USAGE, "needs a token, or --all-of ROBOT", "comes last"),
    WrongInput("token retire", USAGE, "is for a cloud", "--cloud"),
    WrongInput("robot list --name other", USAGE, "there is no platform 'other'", "rse-pf local"),
    WrongInput("robot disable", USAGE, "arguments are required: ROBOT", "rse-pf robot disable --help"),
    WrongInput("robot enrol robot-1 --public-key typo", USAGE, "cannot read typo", "public key that keygen printed"),
    WrongInput("robot enrol robot-1 --public-key broken.json", USAGE, "this is not a public key", "rse-pf robot keygen"),
    WrongInput("robot enable robot-1", USAGE, "robot 'robot-1' is not disabled", "rse-pf robot list"),
    WrongInput("map list --name lab", USAGE, "there is no platform 'lab'", "rse-pf local"),
    WrongInput("map backup a.maps --tenant acmee", USAGE, "tenant 'acmee' has no maps", "rse-pf tenant list"),
    WrongInput("map restore missing.maps", USAGE, "missing.maps does not exist", "map backup"),
    WrongInput("robot disable robot-9", USAGE, "robot 'robot-9' is not enrolled", "--not-enrolled"),
    WrongInput("token revoke --all-of robot-9", USAGE, "robot 'robot-9' is not enrolled", "--not-enrolled"),
    WrongInput("tenant quota acmee --quota data_bytes=1", USAGE, "there is no tenant", "rse-pf tenant list"),
    WrongInput("robot remove robot-9", USAGE, "robot 'robot-9' is not enrolled", "rse-pf robot list"),
    WrongInput("robot keygen", USAGE, "arguments are required: --out", "rse-pf robot keygen --help"),
    WrongInput("service nwe x", USAGE, "'nwe' is not one of new", "did you mean new?"),
    WrongInput("service new", USAGE, "arguments are required: NAME", "rse-pf service new --help"),
    WrongInput("service new Mine", USAGE, "'Mine' is not a valid service name", "lower-case letters"),
    WrongInput("service new new-service", USAGE, "new-service exists already", "another name"),
    WrongInput("service test", USAGE, "arguments are required: FOLDER", "rse-pf service test --help"),
    WrongInput("service test typo", USAGE, "cannot read typo/service.json", "rse-pf service new NAME"),
    WrongInput("service test odd", USAGE, "Invalid enum value 'cobol'", '"language": "python"'),
    WrongInput("service test unasked", USAGE, "unasked has no recorded requests", "unasked/requests/NAME.json"),
    WrongInput("service call echo", USAGE, "no platform named 'default' is running", "rse-pf local"),
    WrongInput("service call echo --request {points", USAGE, "--request is not JSON", "write --request"),
    WrongInput("service status --control-port 9", FAILED, "no answer from port 9", "rse-pf local status"),
    WrongInput("service publish", USAGE, "needs the folder of a service", "publish FOLDER, or --list"),
    WrongInput("service publish x --list", USAGE, "--list takes no service", "publish --list"),
    WrongInput("serve --services a --follow-services b", USAGE, "exclude each other", "leave one of them out"),
    WrongInput("serve", USAGE, "there are no keys", "name a key set file"),
    WrongInput("serve --keys typo", USAGE, "cannot read the keys typo: No such file", "rse-pf local writes one"),
    WrongInput("serve --keys empty", USAGE, "this is not a key set", "check empty"),
    WrongInput("serve --port 99999", USAGE, "serving.port = 99999 is above 65535", "lower --port"),
    WrongInput("serve --prot 1", USAGE, "unknown option --prot", "did you mean --port?"),
    WrongInput("serve --announce typo/a.json", USAGE, "there is no folder", "name another --announce"),
    WrongInput("data", USAGE, "--keys is missing", "give a JWKS"),
    WrongInput("data --port 99999 --keys empty", USAGE, "data.port = 99999 is above 65535", "lower --port"),
    WrongInput("data --store tape:x --keys empty", USAGE, "'tape:x' is not a store", "dir:PATH, s3:BUCKET"),
    WrongInput("data --announce typo/a.json --keys empty", USAGE, "there is no folder", "create the folder"),
    WrongInput("replay typo.mcap", USAGE, "there is no file typo.mcap", "rse-pf local --record"),
    WrongInput("replay nothing", USAGE, "there is no recording in nothing", ".mcap"),
    WrongInput("replay empty", FAILED, "empty is empty", "record again"),
    WrongInput("replay picture.png", FAILED, "picture.png is not a recording", "rse-pf local --record wrote"),
    WrongInput("replay picture.png --command robot", USAGE, "'robot' is not the id of a command", "CONNECTION:ID"),
    WrongInput("replay picture.png --command 1 --all", USAGE, "--all is all of them", "leave one of them out"),
    WrongInput("replay picture.png --inlier-px 0", USAGE, "--inlier-px = 0 is not within", "leave it out"),
    WrongInput("replay picture.png --engine magic", USAGE, "'magic' is not one of native", "--help"),
    WrongInput("replay picture.png --html typo/a.html", USAGE, "there is no folder typo", "create it"),
    WrongInput("map lst", USAGE, "'lst' is not one of list", "did you mean list?"),
    WrongInput("map list --store memory:", USAGE, "no store is named", "that of rse-pf local is dir:"),
    WrongInput("map list --store dir:/typo", USAGE, "there is no folder /typo", "check --store"),
    WrongInput("map list --store typo", USAGE, "'typo' is not a store", "dir:PATH"),
    WrongInput("map show attic --store dir:store", FAILED, "there is no map 'attic'", "rse-pf map list"),
    WrongInput("map show hall 3f9bd1 --store dir:store", FAILED, "no version begins with '3f9bd1'", "map show NAME --all"),
    WrongInput("map show hall --png typo/a.png --store dir:store", USAGE, "there is no folder", "create it"),
    WrongInput("map merge hall attic --into one --store dir:store", FAILED, "there is no map 'attic'", "rse-pf map list"),
    WrongInput("batch run merge hall --out one", FAILED, "there is no map 'hall'", "rse-pf map list"),
    WrongInput("batch run merge hall attic --out one --store dir:store", FAILED, "there is no map 'attic'", "rse-pf map list"),
    WrongInput("batch run merge hall --out one --store dir:store --workers 2 --scheduler x:1", USAGE, "exclude each other", "has workers of its own"),
    WrongInput("batch run merge hall --out one --store dir:store --scheduler mars", USAGE, "is no address", "tcp://HOST:PORT"),
    WrongInput("batch run merge hall --out one --store dir:store --workers 0", USAGE, "--workers 0 is not within 1..64", "choose one for each free core"),
    WrongInput("batch clean --store dir:missing", USAGE, "there is no folder missing", "check --store"),
    WrongInput("map localise hall rec-empty --every 0 --store dir:store", USAGE, "--every 0 is below 1", "every frame"),
    WrongInput("map from-bag none.mcap", USAGE, "there is no bag none.mcap", ".db3 or .mcap"),
    WrongInput("map to-bag nothing --out m.mcap", USAGE, "nothing holds no trajectory.txt", "rse-pf demo"),
    WrongInput("map export hall --format stl --out a.stl --store dir:store", USAGE, "'stl' is not one of ply", "--help"),
    WrongInput("map live lst", USAGE, "'lst' is not one of list", "did you mean list?"),
    WrongInput("map live show attic --store dir:store", FAILED, "there is no live map 'attic'", "rse-pf map live list"),
    WrongInput("map live forget Attic robot-1 --store dir:store", FAILED, "'Attic' is not a valid name of a map", "lower-case letters"),
    WrongInput("map publish attic --store dir:store", FAILED, "there is no live map 'attic'", "rse-pf map live list"),
    WrongInput("map export hall --format ply --out typo/a.ply --store dir:store", USAGE, "there is no folder", "create it"),
    WrongInput("map export hall --format tum --out a.txt --robot robot-9 --store dir:store", USAGE, "no keyframe of robot 'robot-9'", "rse-pf map show"),
    WrongInput("map show ../x --store dir:store", FAILED, "'../x' is not a valid name of a map", "use 1 to 64 lower-case letters, digits"),
    WrongInput("map rollback hall abc --store dir:store", FAILED, "no version 'abc'", "give 6 or more hex digits"),
    WrongInput("map prune hall --keep 0 --store dir:store", USAGE, "--keep 0 is below 1", "1 keeps the head and the newest version"),
    WrongInput("map prune attic --keep 1 --store dir:store", FAILED, "there is no map 'attic'", "see rse-pf map list"),
    WrongInput("map export hall --format obj --out x --store dir:store", USAGE, "rse-pf map export: 'obj' is not one of ply, pcd, tum, g2o, colmap, nerfstudio, occupancy, mcap", "see rse-pf map export --help"),
    WrongInput("map merge hall hall --into 'No Name' --store dir:store", FAILED, "is not a valid name of a map", "use 1 to 64 lower-case letters, digits"),
    WrongInput("map localise hall typo.png --store dir:store", USAGE, "no image or recording typo.png", "name an image, a recording, or"),
    WrongInput("map view hall --out /typo/x.png --store dir:store", USAGE, "there is no folder /typo", "create it (mkdir -p /typo), or name"),
    WrongInput("map view attic --store dir:store", FAILED, "there is no map 'attic'", "see rse-pf map list"),
    WrongInput("audit verify", USAGE, "'verify' is not one of show", "see rse-pf audit --help"),
    WrongInput("audit show --name nobody-has-this", USAGE, "there is no audit log in", "start rse-pf local"),
    WrongInput("audit show typo", USAGE, "there is no typo", "name files of logs"),
    WrongInput("audit show audit --last 0", USAGE, "--last 0 shows no entry", "give 1 or more"),
    WrongInput("cloud doctr", USAGE, "'doctr' is not one of up", "did you mean doctor?"),
    WrongInput("cloud cost --robots 0", USAGE, "--robots 0 is not within", "how many robots"),
    WrongInput("cloud cost --hours-per-day 25", USAGE, "--hours-per-day 25 is not within 0..24", "24 is all day"),
    WrongInput("cloud cost --prices broken.json", USAGE, "broken.json holds no prices", "a JSON object"),
    WrongInput("cloud cost --burst -1", USAGE, "--burst -1 is not within 0..1e+09", "commands a day"),
    WrongInput("cloud logs --console", USAGE, "--console needs a server", "rse-pf cloud logs lists them"),
    WrongInput("cloud logs i-1 --lines 0", USAGE, "--lines 0 is not within 1..100000", "how many lines"),
    WrongInput("cloud cost --fps 0", USAGE, "--fps 0 is not within 0..1000", "name frames per second, such as 5"),
    WrongInput("cloud cost --fps nan", USAGE, "--fps nan is not within 0..1000", "name frames per second, such as 5"),
    WrongInput("cloud cost --fps -1", USAGE, "--fps -1 is not within 0..1000", "name frames per second, such as 5"),
    WrongInput("settings scalign", USAGE, "no group named 'scalign'", "groups are serving"),
    WrongInput("settings scaling.min_server", USAGE, "no setting named 'scaling.min_server'", "did you mean scaling.min_servers?"),
    WrongInput("settings --settings typo.json", USAGE, "cannot read typo.json: No such file", "an existing file"),
    WrongInput("settings --settings broken.json", USAGE, "broken.json is not JSON", "correct the file"),
    WrongInput("settings --settings misspelt.json", USAGE, "unknown setting scaling.min_server", "did you mean min_servers?"),
    WrongInput("settings --settings crossed.json", USAGE, "scaling.max_servers = 3 is less than scaling.min_servers = 9", "raise scaling.max_servers"),
    WrongInput("settings --settings range.json", USAGE, "scaling.busy_cpu_percent = 900.0 is above 100", "lower it in cdk.json"),
    WrongInput("doctor now", USAGE, "unrecognized arguments: now", "leave it out"),
    WrongInput("doctor --fix", USAGE, "unknown option --fix", "rse-pf doctor --help"),
    WrongInput("doctor --settings typo.json", USAGE, "cannot read typo.json", "an existing file"),
    WrongInput("errors no-consnsus", USAGE, "there is no error 'no-consnsus'", "did you mean no-consensus?"),
    WrongInput("errors 404", USAGE, "there is no error '404'", "rse-pf errors"),
    WrongInput("errors busy --markdown", USAGE, "--markdown prints all codes", "leave out the code"),
)  # fmt: skip
