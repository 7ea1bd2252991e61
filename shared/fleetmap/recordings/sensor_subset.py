"""Recordings reduced to a subset of their sensors, to compare sensor sets on the same drive."""

from dataclasses import dataclass, replace
from pathlib import Path

from fleetmap.errors import RecordingError, chosen
from fleetmap.geometry import Indices
from fleetmap.recordings import OpenOptions, Recording, open_recording
from fleetmap.recordings.recording import WrappedFrames
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, ImuSamples, SensorSet

# Sensor sets to which each set can be reduced, itself included.
REDUCTIONS: dict[SensorSet, tuple[SensorSet, ...]] = {
    SensorSet.STEREO_INERTIAL: (SensorSet.STEREO_INERTIAL, SensorSet.STEREO, SensorSet.MONO_INERTIAL, SensorSet.MONO),
    SensorSet.STEREO: (SensorSet.STEREO, SensorSet.MONO),
    SensorSet.RGBD: (SensorSet.RGBD, SensorSet.MONO),
    SensorSet.MONO_INERTIAL: (SensorSet.MONO_INERTIAL, SensorSet.MONO),
    SensorSet.MONO: (SensorSet.MONO,),
}


def sensor_set_of(path: Path, options: OpenOptions | None = None) -> SensorSet:
    """Return the sensor set of the recording at `path`; errors as of `open_recording`."""
    with open_recording(path, options) as recording:
        return recording.sensor_set


def named_sensor_set(name: str) -> SensorSet:
    """Return the sensor set of that name; UsageError for an invalid name."""
    return chosen("sensor set of --use", name, {each.value: each for each in SensorSet})


def reduced(recording: Recording, use: SensorSet | None) -> Recording:
    """Return the recording without the sensors missing from `use`, then of a rig its first view; unchanged without `use`.

    Raises RecordingError if the recording lacks a sensor of `use`.
    """
    if use is None or use is recording.sensor_set:
        return recording
    recording = recording.view(0)
    if use not in REDUCTIONS[recording.sensor_set]:
        possible = ", ".join(REDUCTIONS[recording.sensor_set])
        fault = f"is {recording.sensor_set}, it cannot be used as {use}"
        raise RecordingError(f"{recording.path} {fault}; use it as {possible}")
    calibration, imu = recording.calibration, recording.imu
    is_single = use.startswith("mono")
    if not use.endswith("-inertial"):
        calibration, imu = replace(calibration, imu=None), ImuSamples.empty()
    if is_single:
        calibration = replace(calibration, cameras=calibration.cameras[:1])
    frames = _Reduced(recording.frames, is_single)
    return replace(recording, sensor_set=use, calibration=calibration, imu=imu, frames=frames)


def with_other_views(rig: RigCalibration, whole: RigCalibration) -> RigCalibration:
    """Return a first view's calibration, perhaps corrected, with the other views of `whole`, whose clock it corrects too."""
    cameras, count = whole.cameras, len(whole.views[0])
    if len(cameras) == count:
        return rig
    later_s = rig.cameras[0].imu_minus_cam_s - cameras[0].imu_minus_cam_s
    others = [replace(camera, imu_minus_cam_s=camera.imu_minus_cam_s + later_s) for camera in cameras[count:]]
    return replace(rig, cameras=(*rig.cameras, *others))


@dataclass(frozen=True)
class _Reduced(WrappedFrames):
    """Frames of another source, of one camera if `single`. Stored data and hashes are unchanged and complete."""

    single: bool

    def frame(self, index: int) -> CameraFrame:
        frame = self.source.frame(index)
        return CameraFrame(frame.stamp_ns, frame.left) if self.single else frame

    def part(self, indices: Indices) -> "_Reduced":
        return replace(self, source=self.source.part(indices))
