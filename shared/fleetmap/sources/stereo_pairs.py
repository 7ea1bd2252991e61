"""Pairing of left and right images that arrive one by one, by their stamps. Pure."""

from collections import deque

from fleetmap.recordings.images import StoredFrame, StoredImage
from fleetmap.recordings.ordering import PAIR_TOLERANCE_NS

_WAITING = 8


class StereoPairs:
    """Frames of two streams whose stamps are within the tolerance of one rig; what finds no partner is counted."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[tuple[int, StoredImage]]] = {"left": deque(), "right": deque()}
        self.unpaired = 0

    def add(self, side: str, stamp_ns: int, image: StoredImage) -> StoredFrame | None:
        """The frame that `image` completes, None while its partner is missing. side: left or right."""
        others = self._waiting["right" if side == "left" else "left"]
        partner = min(others, key=lambda item: abs(item[0] - stamp_ns), default=None)
        if partner is None or abs(partner[0] - stamp_ns) > PAIR_TOLERANCE_NS:
            own = self._waiting[side]
            own.append((stamp_ns, image))
            if len(own) > _WAITING:
                own.popleft()
                self.unpaired += 1
            return None
        for items in self._waiting.values():
            while items and items[0][0] <= max(partner[0], stamp_ns):
                if items.popleft() is not partner:
                    self.unpaired += 1
        left, right = (image, partner[1]) if side == "left" else (partner[1], image)
        return StoredFrame(stamp_ns if side == "left" else partner[0], left, right)
