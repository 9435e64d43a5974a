#!/bin/sh
# Install what the table of clients needs, as far as it can be had; the table names what is missing, and skips it.
set -eu
cd "$(dirname "$0")/.."

sh scripts/setup.sh dev infra
left_out() {
  echo "clients: $1 is left out, see above" >&2
}
sh scripts/setup.sh browser || left_out "Chromium"
sh scripts/setup.sh rosbridge || left_out "roslibpy"
.venv/bin/npm ci --prefix tests/clients --silent --no-audit --no-fund || left_out "roslib"
# Another Node than that of .venv, so in a folder of its own.
node=.venv/oldest-node
if ! cmp -s locks/oldest-node.txt "$node/installed"; then
  rm -rf "$node"
  { .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check --require-hashes --no-deps \
    --target "$node" -r locks/oldest-node.txt && cp locks/oldest-node.txt "$node/installed"; } || left_out "the oldest Node"
fi
sh scripts/client_cpp.sh || left_out "the C++ client"
