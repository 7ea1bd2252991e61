"""Commands over a site: its building and its areas."""
