"""Pose graphs over SE(3) and Sim(3), robust solving, marginal covariances."""
