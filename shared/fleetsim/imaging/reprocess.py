"""Re-processing of recordings: the pictures through an image pipeline, everything else as it was. Nothing is rendered again."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

from fleetmap.recordings import FrameSource, Recording, StoredFrame
from fleetmap.recordings.export_mcap import copy_to_mcap
from fleetmap.recordings.images import png_image
from fleetmap.sensors.samples import CameraFrame
from fleetsim.imaging.pipelines import ImagePipeline, find_pipeline, process_frame


@dataclass(frozen=True, slots=True)
class _ProcessedFrames:
    """The frames of another source, each through a pipeline."""

    source: FrameSource
    pipeline: ImagePipeline
    seed: int

    def stored(self, index: int) -> StoredFrame:
        """Frame `index`, its pictures as PNG; untouched where the pipeline has no stage."""
        if self.pipeline == ImagePipeline():
            return self.source.stored(index)
        frame, stored = self.frame(index), self.source.stored(index)
        right = None if frame.right is None else png_image(frame.right)
        return replace(stored, left=png_image(frame.left), right=right)

    def frame(self, index: int) -> CameraFrame:
        return process_frame(self.source.frame(index), self.pipeline, self.seed)

    def hash_into(self, digest: "hashlib._Hash") -> None:
        """The other source's content, then pipeline and seed."""
        self.source.hash_into(digest)
        digest.update(repr((self.pipeline, self.seed)).encode())

    def close(self) -> None:
        self.source.close()


def processed(recording: Recording, pipeline: str, seed: int = 0) -> Recording:
    """The recording as cameras with that pipeline would have made it; UsageError for a pipeline that is not known.

    With the seed of its run it equals what `fleetsim record --camera-pipeline` writes.
    """
    return replace(recording, frames=_ProcessedFrames(recording.frames, find_pipeline(pipeline), seed))


def reprocess(recording: Recording, out: Path, pipeline: str, seed: int = 0) -> None:
    """Writes the processed recording as MCAP with lossless pictures."""
    copy_to_mcap(processed(recording, pipeline, seed), out)
