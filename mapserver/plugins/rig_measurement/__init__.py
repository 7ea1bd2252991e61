"""The calibration of a rig, measured from its recordings."""
