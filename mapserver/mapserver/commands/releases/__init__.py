"""Commands over versions."""
