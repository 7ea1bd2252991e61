"""The nightly job of a site: read new recordings, check them, build on the current version, publish if the gate accepts it."""
