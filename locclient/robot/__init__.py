"""One robot, frame by frame: localization, failures, trials of new versions. Pure."""
