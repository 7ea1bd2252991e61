"""Another SLAM system's poses as a survey's initial trajectory: read, compared with the recording, completed."""
