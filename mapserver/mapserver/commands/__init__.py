"""One file for each command of `mapserver`."""
