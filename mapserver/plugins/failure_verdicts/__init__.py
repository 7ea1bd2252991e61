"""Verdicts on failures: is the robot wrong, is the building different, or does it look like another place?"""
