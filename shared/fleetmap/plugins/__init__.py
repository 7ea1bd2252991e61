"""Plug-ins of either side, in a folder each. The rest of the package imports none: see `fleetmap/hooks.py`."""
