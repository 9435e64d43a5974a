#!/bin/sh
# Run the tests of AWS against LocalStack without Docker: install LocalStack from its lock, start it, run the tests,
# and stop it.
# sh scripts/localstack.sh [PYTEST-ARGUMENT...]; by default the tests that need an endpoint of AWS.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
env=.venv-localstack
out=out/localstack

"$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))' || {
  echo "LocalStack: not tested, since it needs Python 3.11 or 3.12, and this is $("$python" --version)" >&2
  exit 3
}
[ -x "$env/bin/python" ] || "$python" -m venv "$env"
wanted=$(sha256sum < locks/localstack.txt)
if [ "$(cat "$env/installed" 2> /dev/null || true)" != "$wanted" ]; then
  echo "LocalStack: installing locks/localstack.txt into $env (once)"
  "$env/bin/python" -m pip install --quiet --disable-pip-version-check --require-hashes --no-deps \
    -r locks/localstack.txt
  echo "$wanted" > "$env/installed"
fi

rm -rf "$out"
mkdir -p "$out"
port=$("$python" -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
# LocalStack downloads nothing, sends no usage data, resolves no names, and listens on loopback only.
GATEWAY_LISTEN="127.0.0.1:$port" LOCALSTACK_HOST="localhost:$port" LOCALSTACK_VOLUME_DIR="$PWD/$out/volume" \
  DISABLE_EVENTS=1 SKIP_SSL_CERT_DOWNLOAD=1 DNS_ADDRESS=0 \
  "$env/bin/python" -m localstack.runtime.main > "$out/localstack.log" 2>&1 &
localstack=$!
trap 'kill "$localstack" 2> /dev/null || true; wait "$localstack" 2> /dev/null || true' EXIT INT TERM
"$python" - "$port" "$localstack" << 'END' || { tail -20 "$out/localstack.log" >&2; exit 1; }
import os, sys, time, urllib.request
port, process, until = sys.argv[1], int(sys.argv[2]), time.monotonic() + 120
while True:
    try:
        urllib.request.urlopen(f"http://127.0.0.1:{port}/_localstack/health", timeout=5).read()
        break
    except OSError as error:
        if time.monotonic() > until or not os.path.exists(f"/proc/{process}"):
            sys.exit(f"LocalStack did not start: {error}")
        time.sleep(0.2)
END
echo "LocalStack: answers on port $port; its log is $out/localstack.log"

if [ $# -eq 0 ]; then
  set -- tests/aws tests/storage/test_object_store.py tests/cli tests/localstack
fi
# The tests run one after the other, since names of buckets are global.
PATH="$PWD/.venv/bin:$PATH" LOCALSTACK_HOST="localhost:$port" .venv/bin/python -m pytest -q -rsfEx -n 0 -m "not slow" "$@"
