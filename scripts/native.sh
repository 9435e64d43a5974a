#!/bin/sh
# Compile the native core into native/build where a C++ compiler is found: sh scripts/native.sh
# Compiles what has changed only, and never fails: without the core, PoseLib solves the poses.
set -u
cd "$(dirname "$0")/.."
log=native/build/build.log
library=native/build/librse_pf_native.so

slower() {
  echo "setup: $1; PoseLib solves the poses instead, for several times the CPU" >&2
  echo "  hint: $2" >&2
  exit 0
}

make -q -C native > /dev/null 2>&1 && exit 0
compiler=${CXX:-}
for each in c++ g++ clang++; do
  [ -z "$compiler" ] && command -v "$each" > /dev/null 2>&1 && compiler=$each
done
[ -n "$compiler" ] || slower "no C++ compiler was found" "sudo apt-get install g++, or CXX=/path/to/one make setup"

mkdir -p native/build
echo "setup: compiling the native core with $compiler (once per change, some seconds)"
make -C native CXX="$compiler" > "$log" 2>&1 && exit 0
# An old library would not be what the sources say.
rm -f "$library"
slower "the native core does not compile with $compiler" "read $log; g++ 11 and clang 14 are new enough"
