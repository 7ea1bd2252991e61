"""Preparation of an installation: kernels compiled by the real code on a drive through a painted room, before anybody waits."""
