"""The right-invariant multi-state constraint Kalman filter."""
