"""The map server: surveys in, immutable map versions out."""
