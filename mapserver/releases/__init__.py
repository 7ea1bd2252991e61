"""Releases of maps: publishing, promoting, rolling back, canaries, and differences between versions."""

from mapserver.releases.release import confirm_calibration as confirm_calibration
from mapserver.releases.release import difference as difference
from mapserver.releases.release import end_canary as end_canary
from mapserver.releases.release import judge_draft as judge_draft
from mapserver.releases.release import promote as promote
from mapserver.releases.release import publish as publish
from mapserver.releases.release import roll_back as roll_back
from mapserver.releases.release import start_canary as start_canary
from mapserver.releases.version_diff import Difference as Difference
