"""The compiled core, built from shared/core. Arrays must be C-contiguous and of the type named here; they are never converted.

The sources there document each function. Images (H, W) uint8 grey, descriptors (N, 4) uint64 of 256 bits, pixels (N, 2) float32.
ValueError for invalid sizes and numbers, TypeError for another kind of array; input that is not finite raises no error.
"""

import collections.abc
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

_Descriptors = NDArray[np.uint64]
_Grey = NDArray[np.uint8]
_Numbers = NDArray[np.int32]
_Indices = NDArray[np.int64]
_Pixels = NDArray[np.float32]
_Reals = NDArray[np.float64]
_Flags = NDArray[np.bool_]
_Floats = NDArray[np.float32]
_Octaves = NDArray[np.int8]
# Of a keyframe: pixels (N, 2), octaves, descriptors, disparities (N, 2), points_cam (N, 3), True if the disparities are measured.
_Features = tuple[_Reals, _Octaves, _Descriptors, _Reals, _Reals, bool]
_Pyramid = tuple[_Grey, _Grey, _Grey]
# Of a view: nearest_px, step_px, sigma_px, lens, cam_from_map, clear_sigmas, clear_m.
_Depths = tuple[_Floats, int, float, _Reals, _Reals, float, float]
# Pixels (M, 2), conics (M, 3), reaches_px (M, 2), peaks (M,), greys (M,).
_Gaussians = tuple[_Reals, _Reals, _Reals, _Reals, _Reals]
_Counts = NDArray[np.uint16]
_Rows = Callable[[_Reals, _Reals, _Reals, _Reals, bool], tuple[_Reals, _Reals, _Reals, _Reals, _Reals]]

def mutual(a: _Descriptors, b: _Descriptors, max_distance: int, ratio: float) -> _Indices:
    """(P, 2) pairs that are each other's nearest."""

def mutual_within(
    a: _Descriptors, nodes_a: _Numbers, b: _Descriptors, nodes_b: _Numbers, max_distance: int, ratio: float
) -> _Indices:
    """(P, 2) pairs that are each other's nearest, among pairs with a common node in nodes_a (A, 2) and nodes_b (B,)."""

def match_projected(
    predicted: _Reals,
    radius_px: _Reals,
    a: _Descriptors,
    octave_range: _Indices,
    pixels: _Reals,
    octaves: _Octaves,
    b: _Descriptors,
    max_distance: int,
    ratio: float,
) -> tuple[_Indices, _Numbers]:
    """(A,) index of the feature of b, at pixels (B, 2), that matches each of a near its predicted pixel (A, 2); their distance."""

def descend(
    descriptors: _Descriptors,
    centres: _Descriptors,
    first_child: _Numbers,
    child_count: _Numbers,
    word_of_node: _Numbers,
) -> _Numbers:
    """(N,) words of a vocabulary's tree, whose arrays have a row for each node."""

class InvertedFile:
    """Index of places by their words."""

    def __init__(self, words: int) -> None: ...
    def add(self, word_ids: _Numbers, weights: _Floats) -> None:
        """Add the next place: its words (W,), ascending, and their weights."""

    def scores(self, word_ids: _Numbers, weights: _Floats) -> _Reals:
        """(P,) of each place: 1 - |a - b|_1 / 2, 1 for equal vectors."""

def refine_pnp(
    points: _Reals,
    pixels: _Reals,
    weights: _Reals,
    lens: _Reals,
    refinement: tuple[float, float, tuple[int, int]],
    cam_from_source: _Reals,
    prior: _Reals | None,
) -> tuple[_Reals, _Reals, _Reals] | None:
    """cam_from_source (4, 4) refined, its information (6, 6) and the squared normalised residuals (N,); None where singular.

    points (N, 3) in the source frame, pixels (N, 3) u_left v u_right (NaN none), weights (N, 2) 1 / sigma of u and v, of the disparity.
    lens: focal, cx, cy, focal * baseline. refinement: width of the robust weight in sigmas, squared gate of inliers, iterations on
    all and on inliers. prior (6, 6): information on the initial pose.
    """

def ransac_pnp(
    points: _Reals,
    pixels: _Reals,
    weights: _Reals,
    lens: _Reals,
    refinement: tuple[float, float, tuple[int, int]],
    threshold_px: float,
    min_inliers: int,
    draws: _Reals,
    confidence: float,
) -> tuple[_Reals, _Reals, _Reals] | None:
    """As refine_pnp without an initial pose. draws (I, 3) in [0, 1) select the three points of each proposal."""

def pnp_with_rotation(
    points: _Reals,
    pixels: _Reals,
    weights: _Reals,
    lens: _Reals,
    refinement: tuple[float, float, tuple[int, int]],
    threshold_px: float,
    min_inliers: int,
    rotation: _Reals,
    rotation_sigma_rad: float,
) -> tuple[_Reals, _Reals, _Reals] | None:
    """As ransac_pnp with a nearly known rotation (3, 3)."""

def visible_landmarks(
    cones: tuple[_Reals, _Floats, _Floats, _Floats],
    map_from_cam: _Reals,
    pinhole: _Reals,
    distance_scale: float,
    margin_px: float,
    max_view_angle_rad: float,
    octave_scale: float,
) -> tuple[_Indices, _Reals, _Reals]:
    """Rows (V,), pixels (V, 3) u_left v u_right and octaves (V,) of the landmarks in the image widened by margin_px.

    cones: points_map (N, 3), directions_map (N, 3), half_angles_rad (N,), max_distances_m (N,), these times distance_scale.
    pinhole: focal, cx, cy, focal * baseline, width, height. max_view_angle_rad: largest angle of view outside a landmark's cone.
    """

class ProtectionBank:
    """Filters of the pose of which each never used one group of a fix's matches, one fix, or the odometry. See docs/warranty.md."""

    def __init__(self) -> None: ...
    def update(
        self,
        points: _Reals,
        pixels: _Reals,
        weights: _Reals,
        lens: _Reals,
        refinement: tuple[float, float, tuple[int, int]],
        middle: _Reals,
        map_from_body: _Reals,
        body_from_cam: _Reals,
        size_px: tuple[float, float],
        base_z_m: float,
        is_even: bool,
        stamp_s: float,
        way: _Reals,
        cov_way: _Reals,
    ) -> None:
        """Update by a fix, map_from_body (4, 4), and its matches as of refine_pnp. way (4, 4): of the body since the last fix, with its
        covariance (6, 6) about its end. middle (3,): of x / z, y / z and z in the camera, of all landmarks that should be in view.
        base_z_m: height of the robot's base in the map. is_even: low and high ones of them were matched alike, as of `is_even`."""

    def repeat(self) -> None:
        """Count another fix from the viewpoint of the last one that agrees with it: no fault of one fix alone."""

    def level(
        self, map_from_body: _Reals, way: _Reals, cov_way: _Reals, cov_map: _Reals, point: _Reals, risk: float
    ) -> tuple[float, float]:
        """Levels, metres and radians, of a pose at the end of a way since the last fix; infinite without one. cov_map (6, 6): of the map's
        own error there. point (3,): of the body; the position is that of both. risk: probability of an error beyond a level."""

class FixFinder:
    """Finds places of frames in the landmarks (N) and places (K) of one map, by the settings of relocalization and of disparities.

    cones, pinhole, distance_scale, octave_scale: as of visible_landmarks. Place k shows landmarks shown[shown_from[k] : shown_from[k + 1]].
    """

    def __init__(
        self,
        cones: tuple[_Reals, _Floats, _Floats, _Floats],
        sigmas_m: _Floats,
        descriptors: _Descriptors,
        map_from_cam: _Reals,
        shown: _Indices,
        shown_from: _Indices,
        pinhole: _Reals,
        distance_scale: float,
        octave_scale: float,
        fix: object,
        stereo: object,
        min_inlier_share: float,
        refinement: tuple[float, float, tuple[int, int]],
        clearance_px: _Grey | None = None,
    ) -> None: ...
    def by_projection(
        self,
        features: tuple[_Reals, _Reals, _Octaves, _Descriptors],
        unmeasured: tuple[_Grey, _Grey, _Reals, _Flags] | None,
        map_from_cam: _Reals,
        radius_px: float,
        earlier: collections.abc.Sequence[
            tuple[
                tuple[_Reals, _Reals, _Octaves, _Descriptors],
                tuple[_Grey, _Grey, _Reals, _Flags] | None,
                _Reals,
                float,
                float,
            ]
        ] = (),
    ) -> (
        tuple[
            _Reals, _Reals, int, int, _Indices, _Indices, _Flags, tuple[_Reals, _Reals, _Reals], _Indices, _Flags, bool
        ]
        | None
    ):
        """Find the verified pose near map_from_cam, None without one.

        features: pixels (M, 3) u_left v u_right, those in the left image (M, 2), octaves, descriptors. unmeasured: the pair of images,
        pixels again and flags of tried features (M,), both of which are written. earlier: at most 16 more frames to which the
        pose is fitted, each with its features, pair of images, cam_from_query (4, 4) and sigmas of that motion, of rotation and position.
        Returns map_from_cam and its covariance, the numbers of image cells and of landmarks with inliers, features and landmarks of the
        final matches (P,), frame by frame, flags of inliers among them, their points (P, 3), pixels (P, 3) and sigmas (P, 2), the
        expected landmarks (E,), flags of seen ones, and True if the survey passed there.
        """

def nearest_cells(descriptors: _Descriptors, centres: _Descriptors, cells: int) -> _Numbers:
    """(N, cells) numbers of the nearest centres, the nearest first; -1 if there are fewer."""

def near_descriptors(
    descriptors: _Descriptors, centres: _Descriptors, cells: int, held: _Descriptors, starts: _Indices, max_bits: int
) -> _Flags:
    """(M,) True for held descriptors within max_bits of any query, in a number of cells nearest to it; starts (C + 1,) of the cells."""

def lookalikes(
    features: _Descriptors,
    heights_m: _Reals,
    landmarks: _Descriptors,
    points_map: _Reals,
    first: int,
    last: int,
    room: int,
) -> _Numbers:
    """(P, 2) up to `room` pairs of features (F) and landmarks [first, last) that look the same at the same height, by landmark."""

def camera_votes(
    pairs: _Numbers, offsets_m: _Reals, points_map: _Reals, low_m: _Reals, cell_m: float, columns: int, rows: int
) -> _Numbers:
    """(columns, rows) numbers of features that vote for a camera in a square of two cells' side that begins at the cell's corner.

    pairs (P, 2) of features and landmarks, all those of a feature together. offsets_m (F, 2): from the camera to each feature's
    point, in the rotation of the hypothesis. points_map (N, 3). low_m (2,): corner of the first cell.
    """

def mark_shared(
    one: tuple[_Reals, _Descriptors, _Flags], other: tuple[_Reals, _Descriptors, _Flags], reach_m: float, max_bits: int
) -> None:
    """Set flags (N,) of landmarks at points_odom (N, 3) that have a look-alike of the other place within reach_m."""

def block_log_odds(
    one: tuple[_Reals, _Reals, _Flags],
    other: tuple[_Reals, _Reals, _Flags],
    lattices: _Reals,
    model: tuple[float, float, float, float, float],
    block_m: float,
    room: int,
) -> _Reals:
    """(room,) log odds of the first place against the second, of each block of cells by its strongest lattice.

    one, other: points_odom (N, 3), log likelihoods (N, 2) if present and if absent, flags of skipped ones (N,). lattices (L, 2): cell
    size in metres, shift as a share of it. model: least landmarks, shares taken, different, odd; threshold.
    """

def png_rows(filtered: _Grey, pixel_bytes: int) -> _Grey:
    """Bytes (H, N) of a PNG file's rows, from filtered ones (H, 1 + N); ValueError for a filter that there is not."""

def reduced(image: _Grey, height: int, width: int) -> _Grey:
    """The image as `cv2.resize` makes it on x86-64, to the bit; on ARM that rounds otherwise. No side may grow, or be 0."""

class Remap:
    """Resamples images by the fixed-point tables of `cv2.convertMaps` as `cv2.remap` does, to the bit; beyond the image all is black."""

    def __init__(self, pixels: NDArray[np.int16], shares: NDArray[np.uint16], height: int, width: int) -> None:
        """pixels (H, W, 2), shares (H, W): of the result; height, width: of the images."""
    def resample(self, image: _Grey) -> _Grey: ...

def brightness(image: _Grey, every: int, bright: int) -> tuple[bytes, float, float, float, float]:
    """Every n-th pixel of every n-th row: mean, standard deviation, share at least as bright; variance of the rows' steps."""

def pixels_of_rays(rays: _Reals, intrinsics: _Reals, lens: _Reals, reach: float) -> _Reals:
    """(N, 2) pixels of rays (N, 3), NaN without one; the camera as in `register_depth`."""

def undistort(lens: _Reals, reach: float, goals_x: _Reals, goals_y: _Reals) -> tuple[_Reals, _Reals]:
    """Points x, y (N,) of the plane z = 1 that the lens k1 k2 p1 p2 k3 k4 k5 k6 maps to the goals; NaN beyond x^2 + y^2 = reach."""

def register_depth(
    depth: _Floats,
    rays: _Reals,
    colour_from_depth: _Reals,
    intrinsics: _Reals,
    lens: _Reals,
    reach: float,
    width: int,
    height: int,
) -> _Floats:
    """(height, width) depth in a camera of the nearest point around each pixel, 0 without one.

    depth (H, W) metres, 0 where unknown, along rays (H W, 3) with z = 1, NaN for none. intrinsics: fx fy cx cy. lens: 8 coefficients,
    radial-tangential, whose image folds back at x^2 + y^2 = `reach`; or 4, equidistant.
    """

def redundant_keyframes(
    order: _Indices,
    rows: _Indices,
    row_starts: _Indices,
    tracks: _Indices,
    starts: _Indices,
    keyframes: _Indices,
    octaves: NDArray[np.int8],
    gap: int,
    visits: int,
    share: float,
    least: int,
) -> _Flags:
    """(K,) keyframes, checked in `order`, of whose tracks a share, and at least `least`, are seen on other visits.

    Visits are more than `gap` keyframes apart. Members (M,) of tracks, by ascending keyframe unless gap is 0: tracks, keyframes,
    octaves; starts (G + 1,) delimits each track's, row_starts (K + 1,) each keyframe's in rows (M,).
    """

def duplicate_landmarks(
    near: _Indices,
    points_map: _Reals,
    sigmas_m: _Reals,
    starts: _Indices,
    obs_keyframe: _Numbers,
    descriptors: _Descriptors,
    most_bits: int,
) -> _Flags:
    """(N,) the less observed landmark of every near pair (P, 2), in order, whose two could be one landmark.

    starts (N + 1,) delimits each landmark's obs_keyframe (M,); descriptors of their first observations.
    """

def medoids(descriptors: _Descriptors, starts: _Indices) -> _Indices:
    """(N,) the row of descriptors nearest to all others of its list, which starts (N + 1,) delimits; 0 for an empty one."""

def choose_landmarks(
    candidates: _Indices,
    starts: _Indices,
    bins: _Indices,
    weights: _Reals,
    cells: _Indices,
    room: _Indices,
    limit: int,
    counts: _Indices,
    chosen: _Flags,
    needs: _Indices,
    bins_per_view: int,
) -> int:
    """Choose at most `limit` candidates, mark them in chosen (N,) and return their number.

    Landmark n is seen in bins[starts[n]:starts[n + 1]]. counts of the bins, room of the cells (N,) and needs of the views are carried on.
    """

def twins(
    descriptors: _Descriptors, points_map: _Reals, reach: int, most: int, max_bits: int, height_m: float, own_m: float
) -> _Flags:
    """(N,) True for landmarks at points_map (N, 3), by ascending z, with a look-alike at equal height farther away than own_m."""

def spread_corners(
    image: _Grey,
    count: int,
    distance_px: float,
    threshold: int,
    border_px: int,
    taken: _Pixels,
    clearance_px: _Grey | None = None,
    scale: float = 1.0,
    clear_px: float = 0.0,
) -> tuple[_Pixels, _Reals]:
    """Up to `count` whole-pixel corners (N, 2), best first, none within distance_px of another or of `taken` (M, 2); their scores (N,).

    The threshold is halved if the image has too little texture for them. clearance_px: distances from the robot's own body, in the
    image of which this one is a copy reduced by `scale`; corners keep clear_px away from it, in pixels of this one.
    """

def centroid_angles_deg(image: _Grey, pixels: _Pixels, radius: int) -> NDArray[np.float32]:
    """(N,) direction from each pixel to the intensity centroid of its disc."""

def match_depth(disparity_px: _Floats, pixels: _Reals, sigma_px: float) -> _Reals:
    """(N, 2) median disparity around pixels (N, 2) of a depth sensor's image, and sigma_px; NaN at depth edges."""

def match_rows(
    left: _Grey,
    right: _Grey,
    left_half: _Grey,
    right_half: _Grey,
    pixels: _Reals,
    prior_px: _Reals,
    stereo: object,
    max_disparity_px: float,
) -> _Reals:
    """(N, 2) disparity and standard deviation of left pixels (N, 2), NaN where unknown; prior_px (N,) NaN for none."""

# --- inertial samples: stamps_ns (N,), gyro_radps and accel_mps2 (N, 3) ---

def imu_intervals(
    stamps_ns: _Indices, gyro_radps: _Reals, accel_mps2: _Reals, start_ns: int, end_ns: int
) -> tuple[_Reals, _Reals, _Reals]:
    """Durations (N,) s of intervals from start to end, rates and forces (N, 3) at their middles."""

def preintegrate(
    stamps_ns: _Indices,
    gyro_radps: _Reals,
    accel_mps2: _Reals,
    start_ns: int,
    end_ns: int,
    gyro_bias: _Reals,
    accel_bias: _Reals,
    noise: tuple[float, float, float, float],
) -> tuple[_Reals, _Reals, _Reals, _Reals, _Reals, float]:
    """Rotation, velocity, position, their Jacobians (5, 3, 3) by the biases, covariance (15, 15), longest gap in seconds.

    noise: densities of gyro and accelerometer and of their biases' walks.
    """

# --- surfels: lengths in metres, points, normals and pixels (N, ...) in `map` or the camera, poses (4, 4), lens (4,) as of StereoCamera ---
SURFEL_EDGE_M: float
SURFEL_LEVELS: int
SURFEL_RANGE_M: tuple[float, float]
SPLAT_LEAST_ALPHA: float

def surfel_stride_px(focal_px: float) -> int:
    """One of so many pixels in a row or column is merged."""

def voxel_keys(points_map: _Floats, levels: _Grey) -> _Indices:
    """(N,) voxel keys of points at these levels."""

class VoxelTable:
    """Voxels of one recording, extended view by view."""

    def __init__(self) -> None: ...
    def add(self, disparity_px: _Floats, sigma_px: float, lens: _Reals, map_from_cam: _Reals, box_map: _Reals) -> None:
        """Merge the points of a view within x and y of a box (2, 2) into voxels.

        disparity_px (H, W): of every surfel_stride_px-th pixel, NaN unknown.
        """

    def surfels(self) -> tuple[_Floats, _Floats, _Grey, _Indices]:
        """Points, normals and levels of the voxels, and the number of views of each."""

def look_at(points_map: _Floats, levels: _Grey, view: _Depths) -> tuple[_Grey, _Pixels]:
    """Marks (N,), 1 seen, 2 seen through, 0 neither; pixels of the points."""

def weigh(
    points_map: _Floats,
    levels: _Grey,
    view: _Depths,
    picture: _Grey,
    falloff: _Reals,
    log_exposure: float,
    sums: _Reals,
) -> None:
    """Add a view, as of `look_at`, to sums (N, 4).

    1 for a seen point, the weight in views for one seen through, the corrected grey level of a seen one over distance^4, 1 over distance^4.
    """

def discs_before(
    points_map: _Floats,
    normals_map: _Floats,
    cam_from_map: _Reals,
    cosine: float,
    far_m: float,
    pinhole: _Reals,
    width: int,
    height: int,
) -> tuple[_Numbers, _Reals, _Reals]:
    """Numbers of the discs that face the camera in a cone, their points in the camera, and their pixels through a pinhole."""

def draw_discs(
    numbers: _Numbers,
    points_cam: _Reals,
    pixels: _Reals,
    cam_from_map: _Reals,
    normals_map: _Floats,
    levels: _Grey,
    colours: _Grey,
    far_m: float,
    radius_edges: float,
    rays: _Reals,
    pixels_per_rad: _Floats,
) -> tuple[_Floats, _Floats, _Floats]:
    """Weight, and colour and depth along the ray times it, of each pixel (H, W)."""

def blend(gaussians: _Gaussians, width: int, height: int) -> tuple[_Reals, _Reals]:
    """Share of light that passes all Gaussians, and their image (H, W)."""

def blend_backward(gaussians: _Gaussians, opacities: _Reals, blur_px2: float, slopes: _Reals, whole: _Reals) -> _Reals:
    """Gradients (M, 3) of a loss by grey, logarithm of the size and logit of the opacity."""

def allocations() -> int:
    """Number of allocations by this thread's calls during computation; results are not counted."""

def follow_pixels(
    before: _Grey,
    now: _Grey,
    pixels: _Reals,
    predicted: _Reals,
    half: int,
    levels: int,
    within_px: float,
    margin_px: float,
) -> tuple[_Reals, _Flags]:
    """Track windows around pixels (N, 2) to the next image, by pyramids: pixels (N, 2), and flags (N,) of the backward check."""

class Tracker:
    """Tracks points through the frames of a rectified camera; ids ascend and never repeat."""

    def __init__(
        self,
        lens: _Reals,
        settings: object,
        stereo: object,
        max_disparity_px: float,
        refinement: tuple[float, float, tuple[int, int]],
        first_id: int = 0,
    ) -> None: ...
    def begin(self, left: _Grey) -> None:
        """Forget all points; those added next belong to this frame. Call it before the first `track`."""
    def add(self, pixels: _Reals) -> int:
        """Add points (N, 3) and return the first of their ids."""
    def track(
        self,
        left: _Grey,
        pair: tuple[_Grey, _Grey, _Grey] | None,
        disparity_px: _Floats | None,
        cam_from_previous: _Reals | None,
        is_predicted: bool,
        points_cam: _Reals | None,
        clearance_px: _Grey | None = None,
        again: bool = False,  # the frame of the last call, from the points before that
    ) -> tuple[tuple[_Reals, _Reals] | None, float]:
        """Track the points into a frame, predicted by a motion (None: they belong to the frame), measure disparities, add corners.

        pair: right, and both at half size. points_cam (N, 3): the points, by disparities if None. clearance_px: distances from the
        robot's own body; points whose window touches it end. Returns the motion
        (4, 4) and its information (6, 6), None if too few points agree, and the share of the tracked points that follow it.
        """
    ids: _Indices
    pixels: _Reals

def is_image_still(old_ids: _Indices, old_pixels: _Reals, ids: _Indices, pixels: _Reals, limit_px: float) -> bool:
    """True if most of at least ten points seen in both images, pixels (N, 3), have stayed within the limit; ids ascend."""

def align_features(
    reference: tuple[_Pyramid, _Reals, _Octaves, _Pixels, _Indices],
    own: tuple[_Pyramid, _Reals, _Octaves, _Pixels, _Indices],
    points_reference: _Reals,
    own_from_reference: _Reals,
    half: int,
    max_shift_px: float,
    min_correlation: float,
) -> _Reals:
    """(N, 3) x, y, sigma_px of chosen features (N,) of pyramid, pixels, octaves, angles, NaN where patches do not agree."""

def match_guided(
    a: _Features,
    b: _Features,
    b_from_a: _Reals,
    lens: _Reals,
    size_px: tuple[float, float],
    sigma_px: float,
    refinement: tuple[float, float, tuple[int, int]],
    max_distance: int,
    radii_px: _Reals,
    least_inliers: int,
    least_share: float,
) -> tuple[int, _Numbers, _Reals, _Reals]:
    """Number of radii at which matches of a keyframe with another near a motion gave the motion; the matches (P, 2) both ways
    if all did, the motion b_from_a (4, 4), its information (6, 6)."""

def share_in_view(
    b_from_a: _Reals, points_a: _Reals, disparities_a: _Reals, lens: _Reals, size_px: tuple[float, float]
) -> float:
    """Share of a's points (N, 3) with a disparity (N, 2) in view of b, at a similar distance."""

def join_tracks(first: _Numbers, second: _Numbers, keyframes: _Numbers) -> _Numbers:
    """(V,) root of each node after the links first-second, except links that would put a keyframe twice into a group."""

# --- dense stereo: every DENSE_STEP_PX-th pixel each way, by DENSE_BLOCK_PX around it ---
DENSE_STEP_PX: int
DENSE_BLOCK_PX: int
DENSE_FRACTIONS: int
DENSE_MOST_PX: int

def match_densely(left: _Grey, right: _Grey, farthest_px: float) -> NDArray[np.int16]:
    """Disparities of the left picture in DENSE_FRACTIONS of a pixel, 0 unknown; farthest_px: 0 to DENSE_MOST_PX."""

# --- grid: windows and tiles of cells, with 8 voxels each (see grid.cpp) ---
GRID_RAY_STRIDE_PX: int
GRID_CLEAR_SIGMAS: float

def cast_view(
    disparity_px: _Floats,
    nearest_px: _Floats,
    sigma_px: float,
    lens: _Reals,
    map_from_cam: _Reals,
    camera: _Reals,
    was_free: _Grey,
) -> tuple[_Counts, _Grey, _Grey]:
    """Samples (R, C, 8) in voxels, voxels that rays pass or would pass, and codes (R, C, 2) of the lowest and the highest point."""

def add_view(
    points: _Counts,
    looks: _Grey,
    heights: _Grey,
    row: int,
    column: int,
    hits: _Grey,
    passes: _Grey,
    hidden: _Grey,
    tile_heights: _Grey,
) -> bool:
    """Add a window to the counts of a tile, whose cell (0, 0) is at the window's (row, column); False if it is empty there."""

def inertial_residual(
    map_from_body: _Reals, motions: _Reals, gravity: _Reals, increments: _Reals
) -> tuple[_Reals, _Reals]:
    """(15,) rotation, velocity, position and biases of the later of two keyframes against the preintegration; (15, 30) its derivatives.

    map_from_body (2, 4, 4); motions (2, 9): velocity, gyro bias, accelerometer bias. increments (67,): dt, dR, dv, dp, the five
    derivatives by the biases, and their linearisation point.
    """

def image_rows(
    lens: _Reals,
    cam_from_body: _Reals,
    right_m: _Reals,
    map_from_body: _Reals,
    points_map: _Reals,
    obs_keyframe: _Numbers,
    obs_landmark: _Numbers,
    measured: _Reals,
    as_given: _Reals,
    sigmas: _Reals,
    slopes: tuple[_Reals, _Reals, _Reals, _Reals, _Reals, _Indices, float] | None,
) -> tuple[_Reals, _Reals, _Reals]:
    """Whitened rows of M observations: residuals (M, 4), and with slopes the derivatives by point (M, 4, 3) and calibration (M, 4, C).

    lens (4,): focal lengths of the left and the right pinhole, cx, cy. right_m (3,): the right camera in axes of the left one, or zero.
    measured (M, 4): left pixel, disparity and row difference; as_given (M, 2, 2) turns their errors; sigmas (M, 4), infinite without an
    observation. slopes: (M, 4, C) of `measured`, (M, 2, 2, C) of as_given; angular rates (K, 3), motions (K, 9); right_m's (3, 3) by the
    baseline and its direction; columns (7,) of turn, shift, time offset, focal ratio and those three; 1 plus the focal ratio.
    """

def camera_equations(
    points_map: _Reals,
    pixels: _Reals,
    sigmas_px: _Reals,
    rows_px: _Reals,
    lens: _Reals,
    cam_from_map: _Reals,
    parameters: _Reals,
    width: float,
) -> tuple[_Reals, _Reals]:
    """Hessian (14, 14) and gradient of a pose and `parameters` (8,), as of `camera_view`, by matches of a frame as of Correspondences."""

class BundleSolver:
    """Bundle adjustment of K keyframes, N landmarks, M observations.

    lens (4,): focal, cx, cy, focal times baseline, of the cameras body_from_cams (V, 4, 4) of each keyframe. motions (K, 9): velocity, gyro
    bias, accelerometer bias, or (K, 0). free (K, 6 or 15): unknowns that move, of pose and motion. obs_keyframe, obs_camera, obs_landmark
    (M,): what sees what. obs_pixels (M, 3): u and v in the left image, u in the right one, NaN without it.
    obs_sigma_px (M, 2): of u and v, and of the disparity. Relative poses i_from_j (R, 4, 4), priors of poses (Q, 4, 4), each with its
    information (6, 6); inertial edges with increments (E, 67) and information (E, 15, 15); motion_mean (K, 9), motion_weight (K, 9)
    1 / sigma^2. huber, cutoff: sigmas of an observation from which its cost is linear, and constant. calibration: further unknowns, theta
    (C,) with weight (C,) 1 / sigma^2 about zero; ways (R, 3), the effect of theta[scale] on the translations of the relative poses; and a
    function of the whitened rows of the images instead of the lens, called with map_from_body, motions, points_map, theta, and True if
    derivatives are wanted: residuals (M, 4), derivatives by point (M, 4, 3) and theta (M, 4, C), positions (K, 3) of the exposed bodies,
    and factors (4,) on the weights of an observation's rows.
    """

    def __init__(
        self,
        lens: _Reals,
        body_from_cams: _Reals,
        map_from_body: _Reals,
        motions: _Reals,
        points_map: _Reals,
        free: _Flags,
        points_held: bool,
        obs_keyframe: _Numbers,
        obs_camera: _Numbers,
        obs_landmark: _Numbers,
        obs_pixels: _Reals,
        obs_sigma_px: _Reals,
        relative_ends: _Indices,
        i_from_j: _Reals,
        relative_information: _Reals,
        prior_keyframe: _Indices,
        prior_map_from_body: _Reals,
        prior_information: _Reals,
        edge_ends: _Indices,
        increments: _Reals,
        edge_information: _Reals,
        motion_mean: _Reals,
        motion_weight: _Reals,
        gravity: _Reals,
        huber: float,
        cutoff: float,
        calibration: tuple[_Reals, _Reals, _Reals, int, _Rows] | None = None,
    ) -> None: ...
    @property
    def unknowns(self) -> int:
        """Number U of unknowns of the reduced system."""

    def nodes(self) -> tuple[_Indices, _Indices]:
        """Sizes (N,) and couplings (B, 2) of the reduced system's blocks."""

    def factorise_sparsely(self, order: _Indices) -> int:
        """Use sparse factorisation from now on and return the number of values of a factor.

        order (N,): elimination order of the nodes with little fill-in.
        """

    def cost(self) -> float:
        """Half the robust sum of squares of all residuals."""

    def optimize(
        self, lambda_start: float, max_iterations: int, relative_cost_tolerance: float
    ) -> tuple[_Reals, int, bool]:
        """Costs at the start and after every accepted step, the number of iterations, and True if it converged."""

    def reduced(self, damping: float) -> tuple[_Reals, _Reals]:
        """The reduced system at the current values: (U, U), of which the lower triangle counts, and its right-hand side (U,)."""

    def step(self, damping: float) -> _Reals | None:
        """(U,) damped step from the current values; None if the system is not positive definite."""

    def log_determinant(self) -> float:
        """Log determinant of the undamped normal equations, landmarks included; NaN if they are not positive definite."""

    def map_from_body(self) -> _Reals:
        """(K, 4, 4)"""

    def motions(self) -> _Reals:
        """(K, 9) or (K, 0)"""

    def points_map(self) -> _Reals:
        """(N, 3)"""

    def calibration(self) -> _Reals:
        """(C,), empty if fixed"""

    def squared_sigmas(self) -> _Reals:
        """(M,) squared residuals in sigmas at the last cost, huge for points behind the camera."""

# --- checks of inertial samples; poses ---

def drop_spikes(stamps_ns: _Indices, gyro_radps: _Reals, accel_mps2: _Reals, known: int) -> int:
    """Remove spikes, samples far from both neighbours, in place from the rows after the known ones; return the new end.

    The last sample is compared with one neighbour alone; the very first one has none and stays.
    """

def longest_gap_ns(stamps_ns: _Indices, start_ns: int, end_ns: int) -> int:
    """Longest time without a sample between start and end, both included."""

def velocity_change_rows(
    stamps_ns: _Indices,
    accel_mps2: _Reals,
    frames_ns: _Indices,
    rotations: _Reals,
    turns_rad: _Reals,
    places_m: _Reals,
    middle: int,
) -> _Reals:
    """Rows (3, 16) of `change_of_velocity` for a run of frames, whose weight is largest at `middle`."""

def is_steady(gyro_radps: _Reals, accel_mps2: _Reals, limits: tuple[float, float, float, float, float]) -> bool:
    """True if the means of tenths of a window agree, and are those of a body at rest or at constant speed.

    limits: largest standard deviation of the means of gyro and of accel, largest mean of gyro, gravity and its tolerance.
    """

def latest_steady(
    stamps_ns: _Indices,
    gyro_radps: _Reals,
    accel_mps2: _Reals,
    first_ns: int,
    until_ns: int,
    window_ns: int,
    limits: tuple[float, float, float, float, float],
) -> int:
    """End of the latest steady window that begins at first_ns or later; a stamp before first_ns if there is none."""

def compose_pose(
    map_from_body: _Reals, covariance: _Reals, body_from_next: _Reals, cov_step: _Reals
) -> tuple[_Reals, _Reals]:
    """map_from_next (4, 4) and its covariance (6, 6), see `pose_covariance.compose_cov`."""

def adjust_window(
    map_from_cam: _Reals,
    held: int,
    points: _Reals,
    starts: _Indices,
    views: _Indices,
    pixels: _Reals,
    lens: _Reals,
    sigma_px: float,
    huber_sigmas: float,
    iterations: int,
) -> tuple[_Reals, _Reals, _Reals, float]:
    """Bundle adjustment of one camera's views (V, 4, 4), of which the first `held` stay: views, points, squares, half their robust sum.

    points (N, 3); starts (N + 1,) delimits each one's rows of views (M,) and pixels (M, 2). squares (M,) in sigmas.
    """

# --- tracks of points through cameras: views (n,) of odom_from_cam (M, 4, 4), pixels (n, 3) u_left v u_right, NaN none; lens (4,) ---

def triangulate(
    odom_from_cam: _Reals,
    views: _Indices,
    pixels: _Reals,
    lenses: _Reals,
    pixel_weight: float,
    disparity_weight: float,
    start: _Reals,
) -> _Reals:
    """The point (3,) of one track by least squares from a start (3,); NaN unless it converges in front of every camera.

    views (n,): the camera, among odom_from_cam (V, 4, 4) with lenses (V, 4), of each of the pixels (n, 3).
    """

def linearise_track(
    point: _Reals,
    odom_from_cam: _Reals,
    views: _Indices,
    pixels: _Reals,
    lenses: _Reals,
    pixel_weight: float,
    disparity_weight: float,
) -> _Reals:
    """(R, 3 + 6 n + 6) weighted rows of one track, given as to `triangulate`.

    Derivatives by point, bodies, disparity's errors and slips; last the residual.
    """

def share_that_passes(limit: float, mean_square: float) -> float:
    """Remaining share of a normal error's variance if errors whose square exceeds the limit are rejected."""

class Filter:
    """The right-invariant multi-state constraint filter. Errors: rotation, velocity, position, biases of gyro and accelerometer, time
    offset, then rotation and position of each clone; in true_error_cov four considered ones come first.

    true = Exp(error) * estimate, in `odom` axes. ValueError for an unknown clone_id.
    """

    def __init__(
        self,
        rotation: _Reals,
        velocity: _Reals,
        position: _Reals,
        gyro_bias: _Reals,
        accel_bias: _Reals,
        nav_covariance: _Reals,
        nav_true_error: _Reals,
        lenses: _Reals,
        body_from_cams: _Reals,
        settings: object,
        gate_quantile: float,
        gravity_mps2: float,
    ) -> None:
        """Covariances (15, 15); lenses (C, 4) and body_from_cams (C, 4, 4) of the rig's cameras.

        settings has the fields of FilterSettings; gate_quantile: the normal distribution's, at the gate.
        """

    def predict_inertial(
        self,
        stamps_ns: _Indices,
        gyro_radps: _Reals,
        accel_mps2: _Reals,
        start_ns: int,
        end_ns: int,
        noise: tuple[float, float, float, float],
        true_noise: tuple[float, float, float, float],
    ) -> _Reals:
        """Move the state through inertial samples; return the last angular rate (3,), bias removed. noise weighs, true_noise is real."""

    def predict_random_walk(
        self,
        body_from_next: _Reals,
        rotation_sigma_rad: float,
        translation_sigma_m: float,
        duration_s: float = 0.0,
        measured_cov: _Reals | None = None,
    ) -> None:
        """Move the state by a relative transform, uncertain by the sigmas.

        measured_cov (6, 6), in the next body's axes, rotation first, is added information if given.
        """

    def add_clone(self, clone_id: int, rate_body_radps: _Reals) -> None:
        """Keep the current body transform in the window; the rate links it to the time offset."""

    def remove_clone(self, clone_id: int) -> None:
        """Marginalise a clone."""

    def return_to_clone(self, clone_id: int) -> None:
        """Reset rotation and position of the state to a clone's, with its covariance."""

    def begin_frame_anew(self) -> _Reals:
        """new_odom_from_old_odom (4, 4): move the frame's origin to the newest clone, from which errors count.

        Motions between clones and their covariances stay. Velocity and biases must be unused.
        """

    def observe(self, frame_index: int, camera: int, ids: _Indices, pixels: _Reals) -> None:
        """Add the observations of one camera, counted from 0, in a frame: ids (N,), pixels (N, 3) u_left v u_right, NaN if unknown.

        Used once a clone has the frame's index.
        """

    def update(
        self,
        alive: _Indices,
        due: _Flags,
        first_depth_m: float,
        iterations: int = 1,
        newest_odom_from_body: _Reals | None = None,
        sigma_scale: float = 1.0,
    ) -> NDArray[np.int8]:
        """Use each observation once, of ended and due tracks with two or more observations in the clones.

        alive (N,): ids in the newest frame, due (N,): those to use now. Due tracks with one observation stay, ended ones are
        forgotten. Returns for each track (T,), by ascending ids: 1 used, 0 not triangulated, -1 rejected by its gate.

        The search for a point starts at the nearest view's disparity, or at first_depth_m along the newest ray without any disparity.
        More than one iteration relinearises (iterated Kalman filter), for large corrections; newest_odom_from_body (4, 4) is then
        the first linearisation point of the newest clone, if vision is better than the prediction. It adds no information. sigma_scale
        widens the measurement noise, for matches less accurate than flow.
        """

    def correct_by_wheels(
        self,
        velocity_base_mps: _Reals,
        yaw_rate_radps: float,
        sigma_mps: float,
        sigma_radps: float,
        gyro_radps: _Reals,
        base_from_body: _Reals,
        gate: float,
    ) -> float:
        """Correct by forward speed, zero sideways and upwards, and yaw rate; return the squared Mahalanobis distance by true_error_cov.

        Changes nothing if that exceeds the gate.
        """

    def correct_by_rest(self, gyro_mean_radps: _Reals, gyro_sigma_radps: float, gate: float) -> float:
        """Correct by standstill, at which the gyro shows only its bias. Otherwise as correct_by_wheels."""

    def correct_by_speed(self, velocity_odom_mps: _Reals, sigma_mps: float) -> None:
        """Correct by the speed (3,) that images show, however far from the state's; it has the axes of `odom`."""

    def inflate(self, clone_id: int, seen_odom_from_body: _Reals, gap_s: float) -> bool:
        """Inflate position and velocity if vision contradicts the prediction since a clone; True if it did.

        Call it before adding the clone of this time.
        """

    def inflate_velocity(self, sigma_mps: float) -> None:
        """Add the variance of an unknown change of velocity."""

    def motion_between(self, earlier_id: int, later_id: int) -> _Reals:
        """earlier_from_later (4, 4) between two clones."""

    def motion_since(self, clone_id: int) -> tuple[_Reals, _Reals]:
        """earlier_from_now (4, 4) between a clone and the newest one, and its covariance (6, 6), a left one in the former's axes."""

    def cam_from_earlier(self, clone_id: int, cam_from_body: _Reals, camera: int = 0) -> _Reals:
        """(4, 4) from a clone's first camera to that of the state."""

    def odom_from_clone(self, clone_id: int) -> _Reals:
        """(4, 4) odom_from_body of a clone."""

    def odom_from_body(self) -> _Reals:
        """(4, 4) of the state."""

    def body_covariance(self) -> _Reals:
        """cov_rot_trans (6, 6) of odom_from_body: rotation error in odom axes, then position error."""

    def nav_state(self) -> tuple[_Reals, _Reals, _Reals, _Reals, _Reals]:
        """Rotation, velocity, position, gyro bias, accelerometer bias."""

    @property
    def clone_ids(self) -> list[int]:
        """Oldest first."""

    velocity_covariance: _Reals

    @property
    def covariance(self) -> _Reals:
        """Covariance that weighs and gates measurements; a copy."""

    @property
    def true_error_cov(self) -> _Reals:
        """Covariance of the true error; a copy."""

    @property
    def offset_sigma_s(self) -> float:
        """Standard deviation of the time offset's true error."""
    imu_minus_cam_s: float

# --- rendering of the simulator (render.cpp), and rays against boxes (rays.cpp) ---

class ScenePainter:
    """Paints the image of one camera: plane (6,) fx fy cx cy width height, rays (H, W, 4) of a lens or none."""

    def __init__(self, plane: _Reals, rays: _Floats) -> None: ...
    def add(
        self,
        faces: tuple[_Reals, _Reals, _Numbers, _Floats, _Reals],
        chunks: tuple[_Numbers, _Reals],
        textures: tuple[_Grey, _Numbers, _Numbers, _Numbers],
        cam_from_map: _Reals,
        centre_map: _Reals,
        samples: int,
        shift_px: tuple[float, float],
        weight: float,
        most_taps: int,
        reflectance: float,
        shadows: _Reals,
        wants_truth: bool,
        radiance: _Reals,
        depth_m: _Floats,
    ) -> None:
        """Add an instant to an image (H, W): faces as of `Faces` with light and strengths of groups; textures as of `Atlas`."""

def develop(
    radiance: _Reals, gain: float, shot: float, read: float, normals: _Floats, key: int, vignetting: _Floats
) -> _Grey:
    """Image (H, W) of grey levels with shot noise (variance per grey level) and read noise (standard deviation)."""

class BoxGrid:
    """Boxes (B, 8) as of `Faces` in a grid between two corners (3,)."""

    def __init__(self, boxes: _Reals, low: _Reals, high: _Reals, cell_m: float) -> None: ...
    def cast(self, origin: _Reals, directions: _Reals, farthest: _Reals) -> tuple[_Reals, _Indices]:
        """Cast rays: (N,) parameters of the nearest hits, up to farthest (N,), and (N, 2) box and side, -1 for none."""

    def bake(
        self,
        quads: _Reals,
        numbers: _Numbers,
        owners: _Numbers,
        owner_shift: int,
        lamps: _Reals,
        reach_m: float,
        has_shadows: bool,
        light: _Floats,
    ) -> None:
        """Add the lamps' (L, 5) direct light to light (groups, samples) of faces; their own boxes come owner_shift later."""
