"""Operators with names: passwords, sessions and tokens, what each may do, and where the server may listen. docs/security.md explains it."""
