"""The map as bytes: tiles, manifests, and the names that address them. Pure; docs/map_format.md describes them byte by byte."""
