"""Who may do what, as rows, and the chain that makes changes to the log visible."""
