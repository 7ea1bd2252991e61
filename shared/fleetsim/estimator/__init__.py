"""Runs without pictures: what an estimator would measure, landmark by landmark."""
