"""Pages for the people who look after the fleet: robots, maps, failures, surveys. Everything they load comes from this server."""
