"""On PYTHONPATH for `make sanitize`: Python takes the core from FLEETMAP_CORE, built with sanitizers, in the place of the usual one."""

import importlib.util
import os
import sys


class _Sanitized:
    def find_spec(self, name, path=None, target=None):  # type: ignore[no-untyped-def]
        if name == "fleetmap._core":
            return importlib.util.spec_from_file_location(name, os.environ["FLEETMAP_CORE"])
        return None


sys.meta_path.insert(0, _Sanitized())  # type: ignore[arg-type]
