"""Plug-ins of a robot, in a folder each. The rest of the package imports none: see `locclient/hooks.py`."""
