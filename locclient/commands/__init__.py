"""One file for each command of `locclient`."""
