"""Operator accounts: passwords, sessions, tokens and rights, and allowed server addresses. See docs/security.md."""
