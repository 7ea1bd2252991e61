"""From odometry and map queries to an estimate with status and covariance. Pure."""
