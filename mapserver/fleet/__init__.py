"""Robots known to a server: their versions, reports and derived results."""
