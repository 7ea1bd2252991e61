"""Sensor sources of running robots and surveys, and the queue between them and the consumer of frames."""
