"""Surveys while they drive: tracking at the speed of the frames, a growing map beside it, and a build at the end."""

from mapserver.live.live_survey import LiveRequest, LiveResult, run_live

__all__ = ["LiveRequest", "LiveResult", "run_live"]
