"""`locclient prepare`: the kernels of a robot are compiled before it drives."""

from collections.abc import Callable, Mapping
from pathlib import Path

import typer


def prepare() -> None:
    """Compile everything that `run` and `replay` compute with, so that no frame waits; at once where that was done before."""
    import fleetmap
    import locclient
    from fleetmap.preparation.kernel_cache import prepare_kernels

    packages = [Path(package.__path__[0]) for package in (fleetmap, locclient)]
    prepare_kernels("locclient", packages, _steps, typer.echo)


def _steps() -> Mapping[str, Callable[[], None]]:
    import cv2

    from fleetmap.preparation.painted_room import rig
    from fleetmap.sensors.rectification import Rectifier
    from fleetmap.sensors.samples import SensorSet
    from locclient.localization.settings import LocalizerSettings
    from locclient.robot.jit_warmup import warm_up_kernels

    cv2.setNumThreads(1)

    def warm_up(sensors: SensorSet) -> None:
        calibration = rig(sensors)
        rectifier = Rectifier(calibration, has_depth=sensors is SensorSet.RGBD)
        warm_up_kernels(calibration, rectifier, LocalizerSettings())

    carried = (SensorSet.STEREO_INERTIAL, SensorSet.STEREO, SensorSet.RGBD)
    return {f"robot with {sensors}": lambda sensors=sensors: warm_up(sensors) for sensors in carried}  # type: ignore[misc]
