#!/bin/sh
# Build the wheel of the native core that loads on old systems: sh scripts/native_wheel.sh INTO [MACHINE [SOURCE]]
# For another machine, or without a C++ compiler, zig compiles, which is installed from its lock (100 MB, once).
set -eu
cd "$(dirname "$0")/.."
into=$1 machine=${2:-$(uname -m)} source=${3:-native}
PATH=$PWD/.venv/bin:$PATH

tag=manylinux_2_28_$machine
[ "$machine" = "$(uname -m)" ] || tag=auto # auditwheel knows the tags of this machine only by their names
compiler=${CXX:-$(command -v c++ || command -v g++ || command -v clang++ || true)}
if [ "$machine" != "$(uname -m)" ] || [ -z "$compiler" ]; then
  sh scripts/tool.sh ziglang build/ziglang
  CXX="$PWD/build/ziglang/ziglang/zig c++ -target $machine-linux-gnu.2.28"
  ZIG_GLOBAL_CACHE_DIR=$PWD/build/zig-cache ZIG_LOCAL_CACHE_DIR=$PWD/build/zig-cache
  export CXX ZIG_GLOBAL_CACHE_DIR ZIG_LOCAL_CACHE_DIR
fi
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
_PYTHON_HOST_PLATFORM=linux-$machine python -m build --wheel --no-isolation --outdir "$work" "$source"
# auditwheel refuses a library that needs newer symbols than its platform tag promises.
python -m auditwheel repair --plat "$tag" --only-plat --wheel-dir "$into" "$work"/*.whl
