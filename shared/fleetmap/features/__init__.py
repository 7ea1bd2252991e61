"""What is found in pictures: corners, descriptors, matches, sub-pixel positions.

To add an extractor: a file and a line.
"""

from fleetmap.features import orb

EXTRACTORS = {"grid-orb": orb.detect}
