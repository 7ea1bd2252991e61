"""Options for sites whose rig is known: their short rides cannot judge the calibration, and their tests are about something else."""

KNOWN_RIG = ("--trust-calibration", "--reason", "the rig is known")
