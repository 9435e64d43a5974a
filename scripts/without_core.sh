#!/bin/sh
# Run the tests that meet the native core in a copy of the checkout that has no library and no compiler.
set -eu
cd "$(dirname "$0")/.."
python=$PWD/.venv/bin/python
copy=$(mktemp -d)
trap 'rm -rf "$copy"' EXIT

if git rev-parse --is-inside-work-tree > /dev/null 2>&1; then
  git ls-files -z | tar --null --files-from=- --ignore-failed-read --create --file=- | tar -x -f - -C "$copy"
else
  tar --exclude=./.venv --exclude=./build --exclude=./native/build --exclude=./node_modules --create --file=- . | tar -x -f - -C "$copy"
fi
cd "$copy"
export CXX=no-compiler PYTHONPATH="$copy"
"$python" - << 'END'
from rse_pf import native
from rse_pf.pnp import usable_engine

assert not native.find_library(), native.find_library()
assert usable_engine("native") == "poselib"
END
"$python" -m pytest -q -p no:cacheprovider -m "not slow and not system" \
  tests/pnp tests/native tests/wire tests/lambda_pnp tests/test_service.py tests/client_sdk/test_robot_answers.py
