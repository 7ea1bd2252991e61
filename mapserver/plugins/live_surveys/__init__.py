"""Surveys mapped during the drive: tracking in real time, a growing map, and a build at the end."""
