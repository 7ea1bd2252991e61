"""The commands of `mapserver`, one file per command or group."""
