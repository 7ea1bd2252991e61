"""Localization and sensors on ROS 2 topics over zenoh, by the keys of rmw_zenoh or of a bridge to DDS, without ROS."""
