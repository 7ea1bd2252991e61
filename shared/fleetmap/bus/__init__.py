"""The bus between server and robots."""
