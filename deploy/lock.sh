#!/bin/sh
# Writes requirements.lock: every library of an installation with the hashes of the files in this machine's package index now.
# Other bytes under the same version are later refused. The deployer creates it, because platforms and indexes
# differ; keep the file, and install every machine of that platform from it:
#   deploy/lock.sh dist/fleetmap-0.1.0-*.whl server requirements.lock
#   pip install --require-hashes --only-binary :all: -r requirements.lock
#   pip install --no-deps dist/fleetmap-0.1.0-*.whl
set -eu
[ $# -ge 3 ] && [ -f "$1" ] || { echo "usage: deploy/lock.sh WHEEL server|client LOCK [OWN WHEEL...]; make the wheel with: python3 -m pip wheel --no-deps --wheel-dir dist ." >&2; exit 2; }
here=$(dirname "$0")
wheel=$1 extra=$2 lock=$3
shift 3
python=${PYTHON:-python3}
report=$(mktemp)
trap 'rm -f "$report"' EXIT
"$python" -m pip install --dry-run --ignore-installed --quiet --only-binary :all: -c "$here/../constraints.txt" --report "$report" "$@" "$wheel[$extra]"
"$python" "$here/lock_report.py" "$report" > "$lock.new"
mv "$lock.new" "$lock"
echo "$lock: $(grep -c '==' "$lock") libraries; keep it beside the wheel"
