"""A map from another SLAM system's poses: python examples/other_trajectory.py RECORDING POSES.tum STORE SITE

Many systems write the poses of the left camera as TUM text (t x y z qx qy qz qw), in a frame of their own. The survey
takes them as its initial trajectory instead of its own odometry, and adjusts them together with the landmarks. Poses of
the body need none of this: `mapserver build --trajectory-source tum --initial-trajectory POSES.tum` reads them.
"""

import sys
from dataclasses import replace
from pathlib import Path

from fleetmap import Recording, Trajectory
from fleetmap.geometry import se3_inverse
from fleetmap.sensors.samples import Stamps
from mapserver import BuildOptions, build_map
from mapserver.build.trajectory_sources import TRAJECTORY_SOURCES


def camera_poses(recording: Recording, stamps_ns: Stamps, file: Path | None) -> Trajectory | None:
    """frame_from_body at the frames' stamps, from a TUM file of frame_from_cam0."""
    of_camera = TRAJECTORY_SOURCES["tum"](recording, stamps_ns, file)  # interpolated at the stamps
    if of_camera is None:
        return None
    cam_from_body = se3_inverse(recording.calibration.cameras[0].body_from_cam)
    return replace(of_camera, frame_from_body=of_camera.frame_from_body @ cam_from_body)


TRAJECTORY_SOURCES["tum-camera"] = camera_poses


def main(recording: str, poses: str, store: str, site: str) -> None:
    """Builds a draft from the poses and says what came of it."""
    options = BuildOptions(trajectory_source="tum-camera", initial_trajectory=Path(poses))
    draft = build_map([recording], store, site, options)
    print(draft.sentence)


if __name__ == "__main__":
    main(*sys.argv[1:])
