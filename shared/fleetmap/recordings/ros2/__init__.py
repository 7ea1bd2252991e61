"""ROS 2 messages without ROS: CDR, definitions, rmw_zenoh keys."""
