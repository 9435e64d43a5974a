#!/bin/sh
# Install the CDK's command line from package-lock.json (once), then run it: sh scripts/cdk.sh [ARGUMENTS]
# Only the version in the lock is used: the newest release cannot read the output of this CDK library.
set -eu
cd "$(dirname "$0")/.."
PATH="$PWD/.venv/bin:$PATH"
export PATH

stamp=node_modules/installed
wanted=$(sha256sum package-lock.json)
if [ "$(cat "$stamp" 2> /dev/null || true)" != "$wanted" ]; then
  npm ci --silent --no-audit --no-fund || {
    echo "cdk: npm could not install package-lock.json" >&2
    echo "  hint: look at npm's lines above; is the network there?" >&2
    exit 2
  }
  echo "$wanted" > "$stamp"
fi
[ $# -gt 0 ] || exit 0
exec npx --no-install cdk --no-notices "$@"
