"""Surveys mapped during the drive: tracking in real time, a growing map, and a build at the end."""

from mapserver.live.drives import Drive, RecordedDrive, SensorDrive
from mapserver.live.live_survey import LiveRequest, LiveResult, run_live

__all__ = ["Drive", "LiveRequest", "LiveResult", "RecordedDrive", "SensorDrive", "run_live"]
