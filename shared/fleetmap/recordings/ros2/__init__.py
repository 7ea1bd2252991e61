"""ROS 2 messages without ROS: CDR and definitions."""
