"""Mapping during the drive: a local map at the newest keyframes, loops, and a pose graph."""
