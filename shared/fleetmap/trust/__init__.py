"""Signed lists of the maps that robots may run (TUF), and the robot's side of them. Imports tuf only to fetch a list."""
