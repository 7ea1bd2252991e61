"""The localization client that runs on a robot."""
