"""Watch over a robot's calibration: what its cameras show, against the map in which it is localized."""
