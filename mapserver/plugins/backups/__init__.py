"""Backups of a store, in a folder or an object store, and stores restored from them."""
