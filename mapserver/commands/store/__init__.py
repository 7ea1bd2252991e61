"""Commands over a store."""
