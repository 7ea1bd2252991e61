#!/bin/sh
# Installs the wheel of this source folder with an extra into a new virtual environment: every library by its hash, without parts for
# development (tests, debug symbols, pip itself). docs/install.md has the sizes.
#   python3 -m pip wheel --no-deps --wheel-dir dist .
#   deploy/install.sh dist/fleetmap-0.1.0-*.whl server /opt/fleetmap
# LOCK: the list of libraries with their hashes, created by lock.sh if missing (default: deploy/EXTRA.lock); keep it.
# WHEELS: folder with your own wheels, such as that of opencv.sh, which have priority over those of the index (default: dist/wheels).
set -eu
[ $# -eq 3 ] && [ -f "$1" ] && [ ! -e "$3/bin" ] || { echo "usage: deploy/install.sh WHEEL server|client FOLDER; FOLDER/bin must not exist; make the wheel with: python3 -m pip wheel --no-deps --wheel-dir dist ." >&2; exit 2; }
here=$(dirname "$0")
wheel=$1 extra=$2 folder=$3
lock=${LOCK:-$here/$extra.lock}
wheels=${WHEELS:-$here/../dist/wheels}
tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT
export PIP_DISABLE_PIP_VERSION_CHECK=1
"${PYTHON:-python3}" -m venv "$tools"
"${PYTHON:-python3}" -m venv --without-pip "$folder"

set --
for own in "$wheels"/*.whl; do
  [ ! -f "$own" ] || set -- "$@" "$own"
done
[ -f "$lock" ] || PYTHON=$tools/bin/python "$here/lock.sh" "$wheel" "$extra" "$lock" "$@"
[ ! -d "$wheels" ] || set -- --find-links "$wheels"
pip() { "$tools/bin/python" -m pip --python "$folder/bin/python" install --quiet "$@"; }
pip --require-hashes --only-binary :all: "$@" -r "$lock"
pip --no-deps "$wheel"

rm -rf "$folder"/lib/python*/site-packages/cv2/data/*.xml
find "$folder"/lib/python*/site-packages/numpy -type d -name tests -prune -exec rm -rf {} +
if command -v strip readelf >/dev/null; then
  # Except the *.libs folders: their bundled libraries were rewritten when the wheels were built, and strip damages such files.
  find "$folder"/lib/python*/site-packages -name '*.so' ! -path '*.libs/*' | while read -r file; do
    ! readelf --sections "$file" | grep -q '\.symtab' || strip --strip-unneeded "$file"
  done
fi
echo "$folder: $(du -sm "$folder" | cut -f1) MiB"
