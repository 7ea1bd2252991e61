"""`mapserver train-vocabulary`: a vocabulary of place recognition."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import ConfigFile, TopicNames, expand_options, settings_of
from fleetmap.errors import UsageError, disk_errors
from mapserver.commands.options import topics_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray

    from fleetmap.features.settings import OrbSettings
    from fleetmap.recordings import OpenOptions


@dataclass(frozen=True, kw_only=True)
class VocabularyOptions:
    """Size of the tree, and the frames that it is trained on."""

    frames: Annotated[str, typer.Option(metavar="A:B:C", help="Slice of each recording's frames.")] = "::10"
    branching: Annotated[int, typer.Option(min=2, max=64, help="Children of each node.")] = 10
    levels: Annotated[int, typer.Option(min=1, max=6, help="Levels of the tree.")] = 4
    seed: Annotated[int, typer.Option(min=0, help="Seed of the clustering.")] = 0


@expand_options
def train_vocabulary(
    context: typer.Context,
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Folders or files.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="File to write.")],
    options: VocabularyOptions,
    topic: TopicNames = None,
    config: ConfigFile = None,
) -> None:
    """Train a vocabulary on the images of recordings, for `build --vocabulary`."""
    from fleetmap.bow import MAX_NODES

    if not out.parent.is_dir():
        raise UsageError(f"--out {out}: the folder {out.parent} does not exist; create it first")
    branching, levels = options.branching, options.levels
    if branching**levels > MAX_NODES // 2:
        words = f"up to {branching**levels} words are too many; use fewer"
        raise UsageError(f"--branching {branching} --levels {levels}: {words}")
    import numpy as np

    from fleetmap.bow import encode_vocabulary, vocabulary_hash
    from fleetmap.bow import train_vocabulary as train
    from fleetmap.recordings import OpenOptions

    orb, opening = settings_of(context).survey.orb, OpenOptions(topics=topics_of(context, topic))
    pictures = [rows for recording in recordings for rows in _descriptors(recording, opening, options.frames, orb)]
    images = np.repeat(np.arange(len(pictures)), [len(rows) for rows in pictures])
    rows = np.concatenate(pictures)
    vocabulary = train(rows, branching, levels, np.random.default_rng(options.seed), images)
    data = encode_vocabulary(vocabulary)
    with disk_errors(f"--out {out} cannot be written", "check folder and space", UsageError):
        out.write_bytes(data)
    typer.echo(
        f"{out}: {vocabulary.word_count} words from {len(rows)} features of {len(pictures)} pictures, {len(data)} bytes, "
        f"{vocabulary_hash(vocabulary)}"
    )


def _descriptors(path: Path, opening: "OpenOptions", frames: str, orb: "OrbSettings") -> "Iterator[NDArray[np.uint8]]":
    """Descriptors (N, 32) of each selected left picture, rectified."""
    from fleetmap.features.extraction import extract
    from fleetmap.recordings import FrameSelection, open_recording
    from fleetmap.sensors.rectification import Rectifier
    from fleetmap.sensors.samples import SensorSet

    with open_recording(path, opening) as recording:
        rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
        for index in FrameSelection.parse(frames).apply(recording):
            yield extract(rectifier.rectify(recording.read_frame(int(index))).left, orb).descriptors
