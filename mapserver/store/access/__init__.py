"""Rights as rows, and the hash chain that reveals changes to the log."""
