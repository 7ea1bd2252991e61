"""Where a running robot's samples come from."""
