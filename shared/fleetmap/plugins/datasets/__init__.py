"""Recordings as folders: EuRoC, TUM-VI, KITTI, 7-Scenes."""
