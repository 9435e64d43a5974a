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
sh scripts/client_cpp.sh || left_out "the C++ client"
