"""The inbox of a site: recordings that arrive, and what became of them."""
