"""Statistics of a fleet: rates with intervals, canary and re-survey tests. Pure."""
