"""The errors of an estimated trajectory against the truth."""
