"""Maps and reports on the bus, and the server's background tasks."""
