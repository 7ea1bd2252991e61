"""The fleet's health for people and other programs: one page for the shift leader, JSON lines, MCAP."""
