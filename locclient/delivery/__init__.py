"""Delivery of failure reports: kept on the disk until the server has them."""
