"""The warehouse simulator: writes recordings that both sides can read."""
