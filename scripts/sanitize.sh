#!/bin/sh
# Build the native core with sanitizers, and run its C++ checks, the Python tests and the fuzz corpus over it:
# sh scripts/sanitize.sh [SECONDS OF FUZZING].  Needs g++ with libasan; without it the script prints a message and
# exits with 0.
set -eu
cd "$(dirname "$0")/.."
seconds=${1:-20}
compiler=${CXX:-g++}
python=.venv/bin/python

skip() {
  echo "sanitize: skipped: $1"
  exit 0
}

command -v "$compiler" > /dev/null 2>&1 || skip "no $compiler"
asan=$("$compiler" -print-file-name=libasan.so)
ubsan=$("$compiler" -print-file-name=libubsan.so)
[ -e "$asan" ] && [ -e "$ubsan" ] || skip "$compiler has no libasan.so and libubsan.so"

folder=$PWD/build/sanitized
flags="-O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all -ftrivial-auto-var-init=pattern"
echo "sanitize: compiling"
mkdir -p "$folder"
make --no-print-directory -C native OUT="$folder/rse_pf_native" CXX="$compiler" EXTRA="$flags" all check > "$folder.log" 2>&1 \
  || { cat "$folder.log" >&2; exit 1; }
tail -n 1 "$folder.log"
: > "$folder/rse_pf_native/__init__.py"

# Leaks of Python at exit are not reported; Python's allocator is off, since it would hide writes beyond a buffer.
export ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 PYTHONMALLOC=malloc
export PYTHONPATH="$folder" LD_PRELOAD="$asan $ubsan"

echo "sanitize: the sanitizer must notice a read behind an array"
if noticed=$("$python" -m scripts.read_too_far 2>&1); then
  echo "sanitize: it did not: $noticed" >&2
  exit 1
fi
case $noticed in
  *heap-buffer-overflow*) ;;
  *) echo "sanitize: it said something else: $noticed" >&2; exit 1 ;;
esac

echo "sanitize: Python tests"
# Left out are tests that compile a library of their own, and tests that measure times or memory.
"$python" -m pytest -q -p no:cacheprovider --timeout 900 -m "not slow and not system" \
  tests/pnp/test_degenerate.py tests/pnp/test_engines.py tests/pnp/test_solver.py \
  tests/pnp/test_depth_refinement.py \
  tests/pnp/test_depth_refinement_oracle.py tests/slam/test_descriptors.py tests/slam/test_orb.py \
  tests/slam/test_stereo.py tests/slam/test_tracking.py tests/client_sdk/test_frontend.py \
  tests/client_sdk/test_point_map.py tests/client_sdk/check/test_figures.py tests/hostile/test_geometry.py
for target in geometry match depth describe track stereo; do
  echo "sanitize: fuzz $target for $seconds s"
  "$python" -m fuzz "$target" --engine hypothesis --seconds "$seconds"
done
echo "sanitize: no findings"
