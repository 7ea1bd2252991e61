"""Bundle adjustment: factors, the reduced system, rounds with outlier removal."""
