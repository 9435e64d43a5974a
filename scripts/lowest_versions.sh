#!/bin/sh
# Run the demo and the Python clients of the table with the lowest versions that pyproject.toml declares, as far as
# they have wheels for this Python: PYTHON=python3.10 sh scripts/lowest_versions.sh
set -eu
cd "$(dirname "$0")/.."
[ -x .venv/bin/uv ] || sh scripts/setup.sh dev
python=$("${PYTHON:-python3}" -c 'import sys; print(sys.executable)')
place=build/lowest
extras="--extra local --extra vision"

# --no-config: the constraints of .venv do not apply, since only pyproject.toml declares versions.
options="--quiet --no-config --only-binary :all: --python $place/bin/python"
.venv/bin/uv venv --quiet --no-config --clear --python "$python" "$place"
# shellcheck disable=SC2086
{
  .venv/bin/uv pip compile pyproject.toml $extras --resolution lowest-direct --no-header --no-annotate \
    --no-emit-package rse-pf-native --output-file "$place/lowest.txt" $options > "$place/compile.log"
  .venv/bin/uv pip install --requirement "$place/lowest.txt" $options
}
# A .pth file makes the checkout importable; an editable install would build the whole checkout again.
printf "%s\n" "$PWD" "$PWD/native" > "$("$place/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/checkout.pth"

"$place/bin/python" --version
"$place/bin/python" -m rse_pf.cli.main demo --robots 1 --frames 10 --out out/lowest/demo
# Left out are two tests that wait for half a minute, and "progress", whose merge needs the extra "maps".
"$place/bin/python" tests/clients/conformance.py --only python,raw --leave-out returns/disabled,returns/away,progress \
  --out out/lowest/clients.json
