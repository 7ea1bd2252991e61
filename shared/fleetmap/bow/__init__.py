"""Bag of binary words: a vocabulary of descriptors and an index that ranks places by appearance."""
