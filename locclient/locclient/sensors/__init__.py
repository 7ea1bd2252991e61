"""Sensor sources of a running robot, and the queue between them and the localizer."""
