"""Plug-ins of the map server, in a folder each. The rest of the package imports none: see `mapserver/hooks.py`."""
