"""Loop closure: candidates by words, gated by position, verified by geometry."""
