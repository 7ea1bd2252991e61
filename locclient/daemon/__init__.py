"""`locclient run`: threads, server connection, publishers."""
