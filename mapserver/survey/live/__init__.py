"""Mapping while the survey drives: a local map at the newest keyframes, loops, and a pose graph."""
