"""The nightly job of a site: take what came in, check it, build on the current version, publish if the gate agrees."""

from mapserver.nightly.night import NightRequest, last_report, run_night

__all__ = ["NightRequest", "last_report", "run_night"]
