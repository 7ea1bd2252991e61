"""Fetching, caching, and selecting tiles."""
