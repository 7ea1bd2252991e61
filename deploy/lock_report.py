"""Turns the report of `pip install --dry-run` into lines for `--require-hashes`: `python lock_report.py REPORT`. See lock.sh."""

import json
import sys
from pathlib import Path


def locked(report: dict) -> list[str]:
    """Return a line for each library except the project itself; SystemExit for a file without a hash in the index."""
    lines = []
    for entry in report["install"]:
        name, version = entry["metadata"]["name"], entry["metadata"]["version"]
        if name == "fleetmap":
            continue
        sha256 = entry["download_info"].get("archive_info", {}).get("hashes", {}).get("sha256")
        if sha256 is None:
            sys.exit(f"{name} {version} came without a SHA-256; install it from an index that names hashes")
        lines.append(f"{name}=={version} --hash=sha256:{sha256}")
    if not lines:
        sys.exit("nothing would be installed; name the wheel and server or client")
    return sorted(lines, key=str.lower)


if __name__ == "__main__":
    sys.stdout.write("".join(f"{line}\n" for line in locked(json.loads(Path(sys.argv[1]).read_text("utf-8")))))
