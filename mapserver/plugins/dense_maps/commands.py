"""`mapserver grid` and `mapserver map`: grid and surfels of a version, for other programs."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option, echo

from fleetmap.cli_options import Group, TopicNames
from fleetmap.errors import StateError, UsageError, disk_errors
from mapserver.commands.options import SiteName, StoreFolder, check_output, open_store, version_named, write_output

RobotHeight = Annotated[
    float, Option(metavar="METRES", help="Height of the tallest robot: higher objects are not obstacles.")
]


def export(
    file: Annotated[Path, Argument(metavar="OUT.yaml", help="File to write; its image OUT.pgm is written beside it.")],
    site: SiteName,
    store: StoreFolder,
    version: Annotated[int | None, Option(min=1, help="Version; default: the current one.")] = None,
    robot_height: RobotHeight = 1.1,
    heights: Annotated[
        Path | None,
        Option(metavar="FILE.npz", help="Write the lowest and highest surface of each cell to this file, too."),
    ] = None,
) -> None:
    """Write the occupancy grid of a version for nav2's map_server, in the robots' map frame."""
    check_output("OUT.yaml", file, ".yaml")
    check_output("--heights", heights)
    import numpy as np

    from fleetmap.version_grid import CELL_M, FREE, OCCUPIED, grid_of, occupancy, write_grid
    from mapserver.plugins.dense_maps.site_grid import height_map

    with open_store(store, read_only=True) as maps:
        version = version_named(maps, site, version)
        tiles = grid_of(maps.manifest(site, version), maps.blob)
    grid = occupancy(tiles, robot_height)
    write_grid(file, grid)
    if heights is not None:
        (lowest, highest), where = height_map(tiles)
        corner_map_m = where.map_from_grid[:2, 3]
        with disk_errors(f"{heights} cannot be written", "choose another place"), heights.open("wb") as stream:
            np.savez_compressed(stream, lowest_m=lowest, highest_m=highest, corner_map_m=corner_map_m, cell_m=CELL_M)
    rows, columns = grid.cells.shape
    free_m2, occupied_m2 = ((grid.cells == state).sum() * grid.resolution_m**2 for state in (FREE, OCCUPIED))
    echo(
        f"site {site}: grid of version {version} is in {file}: {columns} x {rows} cells of {grid.resolution_m} m, "
        f"{free_m2:.1f} m2 free, {occupied_m2:.1f} m2 occupied"
    )


GRID = Group("Planner grid of a version.", {"export": export})


SurfelVersion = Annotated[int, Argument(min=1, help="Version built with the setting surfel_map.")]
SplatFile = Annotated[Path, Argument(metavar="FILE", help="File to write, .ply; replaced if it exists.")]


def splats(version: SurfelVersion, file: SplatFile, site: SiteName, store: StoreFolder) -> None:
    """Write the surfels of a version as 3D Gaussians, in the frame of the map, for viewers of Gaussian splats."""
    check_output("FILE", file, ".ply")
    from mapserver.plugins.dense_maps.splats import Splats, splat_ply
    from mapserver.plugins.dense_maps.surfel_map import surfels_of

    with open_store(store, read_only=True) as maps:
        surfels = surfels_of(maps.manifest(site, version), maps.blob)
    data = splat_ply(Splats.of(surfels))
    write_output(file, data)
    echo(f"site {site}: {len(surfels)} surfels of version {version} are in {file}, {len(data) / 1e6:.1f} MB")


def changes(
    before: SurfelVersion,
    after: Annotated[int, Argument(min=1, help="Another one.")],
    file: Annotated[Path, Argument(metavar="FILE", help="File to write, .png or .geojson; replaced if it exists.")],
    site: SiteName,
    store: StoreFolder,
) -> None:
    """Write appeared and vanished surfels between two versions, as a plan in the frame of the map or as GeoJSON."""
    check_output("FILE", file, ".png", ".geojson")
    from fleetmap.encoding import to_json
    from mapserver.plugins.dense_maps.changes import APPEARED, CELL_M, VANISHED, changes_geojson, changes_png
    from mapserver.plugins.dense_maps.expected_views import SurfelChanges

    with open_store(store, read_only=True) as maps:
        found = SurfelChanges(maps).between(site, before, after)
    is_picture = file.suffix.lower() == ".png"
    write_output(file, changes_png(found) if is_picture else to_json(changes_geojson(found)))
    x, y = found.corner_m
    said = ", ".join(
        f"{sum(patch.kind == kind for patch in found.patches)} patches {kind} ({found.area_m2(kind):.2f} m2)"
        for kind in (APPEARED, VANISHED)
    )
    echo(
        f"site {site}, version {before} to {after}: {said}; {file} has them"
        + (f", its lower left corner at ({x:.2f}, {y:.2f}) m, {CELL_M} m a pixel" if is_picture else "")
    )


def refine(
    version: SurfelVersion,
    recording: Annotated[Path, Argument(help="Recording used to build this version.")],
    file: SplatFile,
    site: SiteName,
    store: StoreFolder,
    steps: Annotated[int, Option(min=1, max=100_000, help="Steps of gradient descent, each on one view.")] = 300,
    seed: Annotated[int, Option(min=0, help="Seed of the order of the images.")] = 0,
    topic: TopicNames = None,
) -> None:
    """Write the surfels as in `map splats`, with colours, sizes and opacities fitted to the pictures of their recording."""
    check_output("FILE", file, ".ply")
    import numpy as np

    from fleetmap.recordings import OpenOptions, named_topics, open_recording
    from mapserver.plugins.dense_maps.refinement import looks_of
    from mapserver.plugins.dense_maps.refinement import refine as refined_by
    from mapserver.plugins.dense_maps.splats import Splats, splat_ply
    from mapserver.plugins.dense_maps.surfel_map import surfels_of
    from mapserver.store.archive import decode_archive

    with open_store(store, read_only=True) as maps:
        manifest = maps.manifest(site, version)
        surfels, archive = surfels_of(manifest, maps.blob), maps.archive(site, version)
    if archive is None:
        raise StateError(
            f"version {version} of site {site} has no archive, which holds the poses of its pictures; name a version built in this store"
        )
    with open_recording(recording, OpenOptions(topics=named_topics(topic))) as opened:
        if opened.content_hash() not in {entry.sha256 for entry in manifest.recordings}:
            names = ", ".join(entry.name for entry in manifest.recordings)
            raise UsageError(f"{recording} is not of version {version} of site {site}, which was built from: {names}")
        images = looks_of(opened.view(0), decode_archive(archive), surfels, own_rig=len(manifest.recordings) == 1)
    done = refined_by(Splats.of(surfels), images, steps, np.random.default_rng(seed))
    said = (
        f"{done.held_out} held-out images: PSNR {done.before.psnr_db:.2f} dB before, {done.after.psnr_db:.2f} dB after, "
        f"SSIM {done.before.ssim:.3f} before, {done.after.ssim:.3f} after"
    )
    if not done.is_better:
        raise StateError(
            f"not better, nothing is written; {said}; `mapserver map splats {version} {file}` writes the surfels as "
            "they are"
        )
    data = splat_ply(done.splats)
    write_output(file, data)
    echo(f"{said}, from {done.learned} other images; {file} has {len(surfels)} splats, {len(data) / 1e6:.1f} MB")


MAP = Group("Surfels of a version.", {"splats": splats, "changes": changes, "refine": refine})
