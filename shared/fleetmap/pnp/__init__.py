"""The pose of one camera from known points (PnP): P3P RANSAC, then robust least squares with covariance."""
