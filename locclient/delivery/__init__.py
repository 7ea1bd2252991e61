"""Delivery of failure reports, which stay on the disk until the server has them."""
