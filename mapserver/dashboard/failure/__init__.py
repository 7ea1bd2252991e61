"""A failure as its page shows it: its story in words and on the map, and the seconds around it to step through."""
