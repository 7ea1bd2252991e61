"""The commands of `mapserver`, a file for each or for those that belong together."""
