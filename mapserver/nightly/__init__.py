"""The nightly job of a site: read new recordings, check them, build on the current version, publish if the gate accepts it."""

from mapserver.nightly.night import NightRequest, last_report, run_night

__all__ = ["NightRequest", "last_report", "run_night"]
