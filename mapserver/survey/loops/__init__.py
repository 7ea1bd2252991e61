"""Loop closure: candidates by bag of words, gated by position, verified by geometry."""
