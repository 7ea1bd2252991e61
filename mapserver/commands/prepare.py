"""`mapserver prepare`: the kernels of builds are compiled before the first recording comes."""

import io
import tempfile
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr
from pathlib import Path

import typer


def prepare() -> None:
    """Compile everything that `build`, `nightly`, `calibrate` and `doctor` compute with; at once where that was done before."""
    import fleetmap
    import mapserver
    from fleetmap.preparation.kernel_cache import prepare_kernels

    packages = [Path(package.__path__[0]) for package in (fleetmap, mapserver)]
    with tempfile.TemporaryDirectory(prefix="fleetmap-") as folder:
        prepare_kernels("mapserver", packages, lambda: _steps(Path(folder)), typer.echo)


def _steps(folder: Path) -> Mapping[str, Callable[[], None]]:
    """Surveys of a painted room, each with what it adds to those before it."""
    import cv2
    import msgspec
    import numpy as np

    from fleetmap.preparation.painted_room import HEIGHT_PX, WIDTH_PX, Ride, write_ride
    from fleetmap.recordings import open_recording
    from fleetmap.sensors.rectification import StereoCamera
    from fleetmap.sensors.samples import SensorSet
    from mapserver import BuildOptions, build_map
    from mapserver.config import survey_settings
    from mapserver.grid.site_grid import SessionViews
    from mapserver.store import Actor
    from mapserver.surfels.expected_view import expected_view, pinhole
    from mapserver.surfels.surfel_map import Surfels
    from mapserver.survey.settings import SurveySettings

    def build(site: str, sensors: SensorSet, settings: SurveySettings | None = None) -> None:
        recording = folder / f"{site}-{sensors}.mcap"
        write_ride(recording, Ride(), sensors)
        with redirect_stderr(io.StringIO()):  # nobody needs to know what so short a survey lacks
            chosen = settings or survey_settings(None, sensors)
            chosen = msgspec.structs.replace(chosen, surfel_map=True)
            built = build_map([recording], folder / "store", site, BuildOptions(settings=chosen))
            if sensors is not SensorSet.MONO:
                built.publish(force=True, actor=Actor("prepare", "a map that nobody drives in"))

    def build_as_large() -> None:
        settings = survey_settings(None, SensorSet.STEREO)
        large = {
            name: msgspec.structs.replace(getattr(settings, name), dense_unknowns=0)
            for name in ("bundle", "rough_bundle", "final_bundle")
        }
        build("large", SensorSet.STEREO, msgspec.structs.replace(settings, **large))

    def register_depth() -> None:
        scene, grey = folder / "scene", np.full((HEIGHT_PX, WIDTH_PX), 100, np.uint8)
        scene.mkdir()
        cv2.imwrite(str(scene / "frame-000000.color.png"), grey)
        cv2.imwrite(str(scene / "frame-000000.depth.png"), grey.astype(np.uint16) * 20)
        np.savetxt(scene / "frame-000000.pose.txt", np.eye(4))
        with open_recording(scene) as recording:
            recording.read_frame(0)

    def look_at_grid() -> None:
        disparity = np.full((HEIGHT_PX, WIDTH_PX), 20.0, np.float32)
        camera = StereoCamera(WIDTH_PX, WIDTH_PX / 2, HEIGHT_PX / 2, 0.1, WIDTH_PX, HEIGHT_PX)
        SessionViews().add((disparity, 0.3), camera, np.eye(4), 0.5)

    def draw_view() -> None:
        camera = StereoCamera(WIDTH_PX, WIDTH_PX / 2, HEIGHT_PX / 2, 0.1, WIDTH_PX, HEIGHT_PX)
        normals, points = np.array([[0, 0, -1]], np.float32), np.array([[0, 0, 1]], np.float32)
        surfels = Surfels(points, normals, np.zeros(1, np.uint8), np.zeros(1, np.uint8))
        expected_view(surfels, pinhole(camera), np.eye(4))

    return {
        "survey with a stereo camera and an IMU": lambda: build("room", SensorSet.STEREO_INERTIAL),
        "second survey of the same place": lambda: build("room", SensorSet.STEREO),
        "survey as large as a site": build_as_large,
        "survey with one camera": lambda: build("mono", SensorSet.MONO),
        "survey with a depth camera": lambda: build("depth", SensorSet.RGBD),
        "depth images of another camera": register_depth,
        "grid of planners": look_at_grid,
        "expected view": draw_view,
    }
