"""Relocalization of one frame in a map: visible landmarks, bag-of-words candidates, PnP, guided matching, look-alike places."""
