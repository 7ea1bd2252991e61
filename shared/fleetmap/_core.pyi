"""The compiled core, of shared/core. Arrays are taken as they are, C-contiguous and of the type named here, and never converted.

Headers there say what each function does. Images (H, W) uint8 grey, descriptors (N, 4) uint64 of 256 bits, pixels (N, 2) float32.
ValueError for sizes and numbers that cannot be, TypeError for another kind of array; what is not finite gives values.
"""

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
# Of a keyframe: pixels (N, 2), octaves, descriptors, disparities (N, 2), points_cam (N, 3), whether the disparities are measured.
_Features = tuple[_Reals, _Octaves, _Descriptors, _Reals, _Reals, bool]
_Pyramid = tuple[_Grey, _Grey, _Grey]
_Counts = NDArray[np.uint16]
_Rows = Callable[[_Reals, _Reals, _Reals, _Reals, bool], tuple[_Reals, _Reals, _Reals, _Reals]]

def nearest_two(a: _Descriptors, b: _Descriptors) -> tuple[_Indices, _Numbers, _Numbers]:
    """Of each of a: (A,) index of the nearest of b, its distance, the second smallest distance."""

def mutual(a: _Descriptors, b: _Descriptors, max_distance: int, ratio: float) -> _Indices:
    """(P, 2) pairs that are each other's nearest."""

def mutual_within(
    a: _Descriptors, nodes_a: _Numbers, b: _Descriptors, nodes_b: _Numbers, max_distance: int, ratio: float
) -> _Indices:
    """(P, 2) pairs that are each other's nearest, of nodes_a (A, 2) and nodes_b (B,) that share one."""

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
    """(A,) index of the feature of b, of pixels (B, 2), that shows each of a near predicted (A, 2); their distance."""

def descend(
    descriptors: _Descriptors,
    centres: _Descriptors,
    first_child: _Numbers,
    child_count: _Numbers,
    word_of_node: _Numbers,
) -> _Numbers:
    """(N,) words of a vocabulary's tree, whose arrays have a row for each node."""

def two_nearest(descriptors: _Descriptors, centres: _Descriptors) -> _Numbers:
    """(N, 2) numbers of the nearest and the second nearest centre."""

class InvertedFile:
    """Places by the words that they show."""

    def __init__(self, words: int) -> None: ...
    def add(self, word_ids: _Numbers, weights: _Floats) -> None:
        """The next place: its words (W,), rising, and their weights."""

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
    all and on inliers. prior (6, 6): information that holds the start.
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
    """As refine_pnp without a start. draws (I, 3) in [0, 1): which three points propose."""

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
    """As ransac_pnp where the rotation (3, 3) is nearly known."""

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
    pinhole: focal, cx, cy, focal * baseline, width, height. max_view_angle_rad: how far outside its cone a landmark may be seen.
    """

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
    ) -> None: ...
    def median_distance_m(self, map_from_cam: _Reals) -> float:
        """Of the landmarks that a camera should see; NaN without any."""

    def by_projection(
        self,
        features: tuple[_Reals, _Reals, _Octaves, _Descriptors],
        unmeasured: tuple[_Grey, _Grey, _Reals, _Flags] | None,
        map_from_cam: _Reals,
        radius_px: float,
    ) -> (
        tuple[_Reals, _Reals, int, _Indices, _Indices, _Flags, tuple[_Reals, _Reals, _Reals], _Indices, _Flags, bool]
        | None
    ):
        """The verified place near map_from_cam, None without one.

        features: pixels (M, 3) u_left v u_right, those in the left image (M, 2), octaves, descriptors. unmeasured: the pair of images,
        pixels again and which features were tried (M,), both of which are written. Returns map_from_cam and its covariance, how many
        parts of the image hold inliers, the features and landmarks matched at the end (P,), which of them are inliers, their points (P, 3),
        pixels (P, 3) and sigmas (P, 2), the landmarks that should be seen (E,), which of them are, and whether the survey passed there.
        """

def nearest_cells(descriptors: _Descriptors, centres: _Descriptors, cells: int) -> _Numbers:
    """(N, cells) numbers of the nearest centres, the nearest first; -1 where there are fewer."""

def near_descriptors(
    descriptors: _Descriptors, centres: _Descriptors, cells: int, held: _Descriptors, starts: _Indices, max_bits: int
) -> _Flags:
    """(M,) which of held are within max_bits of any of descriptors, in so many cells nearest to that; starts (C + 1,) of the cells."""

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
    """(columns, rows) features that vote for a camera in a square of two cells' side that begins at the cell's corner.

    pairs (P, 2) of features and landmarks, all those of a feature together. offsets_m (F, 2): from the camera to what each feature
    shows, turned as the camera would be. points_map (N, 3). low_m (2,): where the cells begin.
    """

def mark_shared(
    one: tuple[_Reals, _Descriptors, _Flags],
    other: tuple[_Reals, _Descriptors, _Flags],
    reach_m: float,
    max_bits: int,
) -> None:
    """Sets flags (N,) of landmarks at points_odom (N, 3) that have one of the other place within reach_m that looks the same."""

def block_log_odds(
    one: tuple[_Reals, _Reals, _Flags],
    other: tuple[_Reals, _Reals, _Flags],
    lattices: _Reals,
    model: tuple[float, float, float, float, float],
    block_m: float,
    room: int,
) -> _Reals:
    """(room,) log odds of the first place against the second, of each block of cells by its strongest lattice.

    one, other: points_odom (N, 3), log likelihoods (N, 2) where present and where absent, which are skipped (N,). lattices (L, 2): cell
    size in metres, shift as a share of it. model: least landmarks, shares taken, different, odd; threshold.
    """

def thin(image: _Grey, every: int, bright: int) -> tuple[_Grey, int, int, int]:
    """Each every-th pixel of each every-th row, their sum, that of their squares, how many are at least so bright."""

def row_steps(image: _Grey, every: int) -> tuple[int, int, int]:
    """Number, sum and sum of squares of the steps from pixel to pixel along each every-th row."""

def undistort(lens: _Reals, goals_x: _Reals, goals_y: _Reals) -> tuple[_Reals, _Reals]:
    """Points x, y (N,) of the plane z = 1 that the lens k1 k2 p1 p2 k3 k4 k5 k6 brings to the goals; not checked."""

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
    """(height, width) depth in a camera of the nearest point around each pixel, 0 where there is none.

    depth (H, W) metres, 0 where unknown, along rays (H W, 3) with z = 1, NaN for none. intrinsics: fx fy cx cy. lens: 8 coefficients,
    radial-tangential, whose image folds back where x^2 + y^2 reaches `reach`; or 4, equidistant.
    """

def spare_keyframes(
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
    """(K,) keyframes of whose tracks a share, and `least`, are seen on so many other visits; visits are `gap` keyframes apart.

    Members (M,) of tracks by rising keyframe: tracks, keyframes, octaves; starts (G + 1,) delimits each track's, row_starts (K + 1,)
    each keyframe's in rows (M,).
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
    """(N,) the less observed landmark of every near pair (P, 2), in their order, that could be one landmark.

    starts (N + 1,) delimits each landmark's obs_keyframe (M,); descriptors of their first observations.
    """

def redundant_keyframes(
    order: _Indices,
    rows: _Indices,
    row_starts: _Indices,
    obs_landmark: _Numbers,
    obs_keyframe: _Numbers,
    octaves: _Indices,
    starts: _Indices,
    observers: int,
    share: float,
) -> _Flags:
    """(K,) keyframes, looked at in `order`, of whose observations a share is repeated by so many that are left.

    row_starts (K + 1,) delimits each keyframe's observations in rows, starts (N + 1,) each landmark's.
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
    """Number of candidates chosen, at most `limit`; marks them in chosen (N,).

    Landmark n is seen in bins[starts[n]:starts[n + 1]]. counts of the bins, room of the cells (N,) and needs of the views are carried on.
    """

def twins(
    descriptors: _Descriptors, points_map: _Reals, reach: int, most: int, max_bits: int, height_m: float, own_m: float
) -> _Flags:
    """(N,) which landmarks at points_map (N, 3), by rising z, look like one that stands as high and further off than own_m."""

def spread_corners(
    image: _Grey, count: int, distance_px: float, threshold: int, border_px: int, taken: _Pixels
) -> tuple[_Pixels, _Reals]:
    """Up to `count` whole-pixel corners (N, 2), best first, none within distance_px of another or of `taken` (M, 2); their scores (N,).

    The threshold is halved where the image is too plain to give them.
    """

def select_spread(
    pixels: _Pixels, order: _Indices, taken: _Pixels, distance_px: float, count: int, width: int, height: int
) -> _Indices:
    """Indices of up to `count` pixels, no two within distance_px."""

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
    max_disparity_px: float,
    min_correlation: float,
    uniqueness: float,
    wide_half: int,
    narrow_half: int,
    agreement_px: float,
) -> _Reals:
    """(N, 2) disparity and standard deviation of left pixels (N, 2), NaN where unknown; prior_px (N,) NaN where there is none."""

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

class BlockCholesky:
    """The pattern of sparse matrices of N nodes with sizes (N,) unknowns each, of which pairs (B, 2) are coupled.

    order (N,): the nodes in an order that fills in little.
    """

    def __init__(self, sizes: _Indices, pairs: _Indices, order: _Indices) -> None: ...
    @property
    def size(self) -> int:
        """How many values a factor has."""

    def order(self) -> _Indices:
        """(U,) the unknowns as they are eliminated."""

    def places(self, rows: _Indices, cols: _Indices) -> _Indices:
        """(B, 3) where blocks of nodes (row, col), which are coupled, stand among the values.

        Number (a, b) of a block belongs at first + a * down + b * right of its row here. A block is added once; its mirror image must
        not be. Of blocks on the diagonal the lower triangle counts.
        """

    def factorise(self, values: _Reals) -> bool:
        """Values (size,) of a matrix become those of its factor; False where it is not positive definite."""

    def solve(self, values: _Reals, rhs: _Reals) -> _Reals:
        """x (U,) of A x = rhs (U,), by the values of the factor."""

# --- surfels: lengths in metres, points, normals and pixels (N, ...) in `map` or the camera, poses (4, 4), lens (4,) as of StereoCamera ---
SURFEL_EDGE_M: float
SURFEL_LEVELS: int
SURFEL_STRIDE_PX: int
SURFEL_RANGE_M: tuple[float, float]
SPLAT_LEAST_ALPHA: float

def voxel_keys(points_map: _Floats, levels: _Grey) -> _Indices:
    """(N,) voxels of points at these levels."""

class VoxelTable:
    """Voxels of one recording, which grow view by view."""

    def __init__(self) -> None: ...
    def add(self, disparity_px: _Floats, sigma_px: float, lens: _Reals, map_from_cam: _Reals) -> None:
        """Merges the points of a view (H, W) into voxels; NaN is unknown."""

    def surfels(self) -> tuple[_Floats, _Floats, _Grey, _Indices]:
        """Points, normals, levels of the voxels, and of how many views each is."""

def look_at(
    points_map: _Floats,
    levels: _Grey,
    nearest_px: _Floats,
    step_px: int,
    sigma_px: float,
    lens: _Reals,
    cam_from_map: _Reals,
    clear_sigmas: float,
    clear_m: float,
) -> tuple[_Grey, _Floats, _Pixels]:
    """Marks (N,), 1 seen, 2 seen through, 0 neither; for how many views the view counts; where the points are."""

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

def blend(
    pixels: _Reals, conics: _Reals, reaches_px: _Reals, peaks: _Reals, greys: _Reals, width: int, height: int
) -> tuple[_Reals, _Reals]:
    """The share of light that passes all Gaussians, and their picture (H, W)."""

def blend_backward(
    pixels: _Reals,
    conics: _Reals,
    reaches_px: _Reals,
    peaks: _Reals,
    greys: _Reals,
    opacities: _Reals,
    blur_px2: float,
    slopes: _Reals,
    whole: _Reals,
) -> _Reals:
    """Gradients (M, 3) of a loss by grey, logarithm of the size and logit of the opacity."""

def allocations() -> int:
    """How often this thread's calls have allocated memory while they computed; results are not counted."""

def halvings(image: _Grey, count: int) -> list[_Grey]:
    """The image halved once, twice and so on, smoothed: pixel (x, y) is (2x, 2y) in the one before."""

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
    """Places (N, 2) of the windows around pixels (N, 2) in the next image, by pyramids, and which were found and lead back (N,)."""

class Tracker:
    """Points followed through the frames of a rectified camera; ids ascend and never repeat."""

    def __init__(
        self,
        lens: _Reals,
        settings: object,
        stereo: object,
        max_disparity_px: float,
        refinement: tuple[float, float, tuple[int, int]],
    ) -> None: ...
    def begin(self, left: _Grey) -> None:
        """Forgets the points; those that are added next are of this frame. Comes before the first `track`."""
    def add(self, pixels: _Reals) -> int:
        """Adds points (N, 3) and returns the first of their ids."""
    def track(
        self,
        left: _Grey,
        pair: tuple[_Grey, _Grey, _Grey] | None,
        disparity_px: _Floats | None,
        cam_from_previous: _Reals | None,
        is_predicted: bool,
        points_cam: _Reals | None,
    ) -> tuple[tuple[_Reals, _Reals] | None, float]:
        """Follows the points into a frame from where a motion takes them (None: they are of it), measures disparities, adds corners.

        pair: right, and both at half size. points_cam (N, 3): where the points are, by disparities where it is None. Returns the motion
        (4, 4) and its information (6, 6), None where too few points agree, and the share of the followed points that moved so.
        """
    ids: _Indices
    pixels: _Reals

def common_ways_px(old_ids: _Indices, old_pixels: _Reals, ids: _Indices, pixels: _Reals) -> _Reals:
    """How far the pixels (N, 3) of ids in both, ascending, lists have moved."""

def align_patches(
    reference: _Pyramid,
    reference_pixels: _Reals,
    reference_octaves: _Octaves,
    current: _Pyramid,
    pixels: _Reals,
    octaves: _Octaves,
    reference_from_current: _Reals,
    half: int,
    max_shift_px: float,
    min_correlation: float,
) -> _Reals:
    """(N, 3) x, y, sigma_px of pixels (N, 2) where patches, warped (N, 2, 2), lie on the reference's; NaN where they do not agree."""

def align_observations(
    reference: tuple[_Pyramid, _Reals, _Octaves, _Pixels, _Indices],
    own: tuple[_Pyramid, _Reals, _Octaves, _Pixels, _Indices],
    points_reference: _Reals,
    own_from_reference: _Reals,
    half: int,
    max_shift_px: float,
    min_correlation: float,
) -> _Reals:
    """As align_patches, of chosen features (N,) of pyramid, pixels, octaves, angles, with warps from the motion where it gives them."""

def warps_from_motion(points_reference: _Reals, current_from_reference: _Reals) -> _Reals:
    """(N, 2, 2) reference_from_current of pixel offsets, NaN where degenerate."""

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
    """How often matches of a keyframe into another near a motion gave the motion, once for each radius; the matches (P, 2) both ways
    where they always did, the motion b_from_a (4, 4), its information (6, 6)."""

def share_in_view(
    b_from_a: _Reals, points_a: _Reals, disparities_a: _Reals, lens: _Reals, size_px: tuple[float, float]
) -> float:
    """Share of a's points (N, 3) with a disparity (N, 2) that b sees, at a similar distance."""

def join_tracks(first: _Numbers, second: _Numbers, keyframes: _Numbers) -> _Numbers:
    """(V,) root of each node after the links first-second, none of which puts a keyframe twice into a group."""

# --- grid: windows and tiles of cells, with 8 voxels each (see grid.h) ---
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
    """Pixels (R, C, 8) in voxels, which of them rays pass or would, and codes (R, C, 2) of the lowest and the highest point."""

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
) -> None:
    """Adds a window to the counts of a tile, whose cell (0, 0) is at the window's (row, column)."""

def inertial_residual(
    map_from_body: _Reals, motions: _Reals, gravity: _Reals, increments: _Reals
) -> tuple[_Reals, _Reals]:
    """(15,) rotation, velocity, position and biases of the later of two keyframes against what was preintegrated; (15, 30) its derivatives.

    map_from_body (2, 4, 4); motions (2, 9): velocity, gyro bias, accelerometer bias. increments (67,): dt, dR, dv, dp, the five
    derivatives by the biases, and the biases that they were taken at.
    """

class BundleSolver:
    """Bundle adjustment of K keyframes, N landmarks, M observations.

    lens (4,): focal, cx, cy, focal times baseline. motions (K, 9): velocity, gyro bias, accelerometer bias, or (K, 0). free (K, 6 or 15):
    unknowns that move, of pose and motion. obs_pixels (M, 3): u and v in the left image, u in the right one, NaN without it.
    obs_sigma_px (M, 2): of u and v, and of the disparity. Relative poses i_from_j (R, 4, 4), priors of poses (Q, 4, 4), each with its
    information (6, 6); inertial edges with increments (E, 67) and information (E, 15, 15); motion_mean (K, 9), motion_weight (K, 9)
    1 / sigma^2. huber, cutoff: sigmas of an observation from which its cost is linear, and constant. calibration: what moves besides, theta
    (C,) with weight (C,) 1 / sigma^2 about zero; ways (R, 3), what theta[scale] adds to the translations of the relative poses; and what
    says the whitened rows of the images in the place of the lens, called with map_from_body, motions, points_map, theta, and whether
    derivatives are wanted: residuals (M, 4), derivatives by point (M, 4, 3) and theta (M, 4, C), positions (K, 3) of the exposed bodies.
    """

    def __init__(
        self,
        lens: _Reals,
        body_from_cam: _Reals,
        map_from_body: _Reals,
        motions: _Reals,
        points_map: _Reals,
        free: _Flags,
        points_held: bool,
        obs_keyframe: _Indices,
        obs_landmark: _Indices,
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
        """U, of the reduced system."""

    def nodes(self) -> tuple[_Indices, _Indices]:
        """Sizes (N,) and couplings (B, 2) of the reduced system's blocks."""

    def factorise_sparsely(self, order: _Indices) -> None:
        """Sparse factorisation from now on; order (N,): the nodes in an order that fills in little."""

    def cost(self) -> float:
        """Half the robust sum of squares of everything."""

    def optimize(
        self, lambda_start: float, max_iterations: int, relative_cost_tolerance: float
    ) -> tuple[_Reals, int, bool]:
        """Costs at the start and after every accepted step, the number of iterations, and whether it converged."""

    def reduced(self, damping: float) -> tuple[_Reals, _Reals]:
        """The reduced system at the current values: (U, U), of which the lower triangle counts, and its right-hand side (U,)."""

    def step(self, damping: float) -> _Reals | None:
        """(U,) damped step from the current values; None where the system is not positive definite."""

    def log_determinant(self) -> float:
        """Of the undamped normal equations of everything, landmarks included; NaN where they are not positive definite."""

    def map_from_body(self) -> _Reals:
        """(K, 4, 4)"""

    def motions(self) -> _Reals:
        """(K, 9) or (K, 0)"""

    def points_map(self) -> _Reals:
        """(N, 3)"""

    def calibration(self) -> _Reals:
        """(C,), none where it is held"""

    def squared_sigmas(self) -> _Reals:
        """(M,) squared residuals in sigmas at the last cost, huge for points behind the camera."""

# --- inertial samples before they are used; poses ---

def drop_spikes(stamps_ns: _Indices, gyro_radps: _Reals, accel_mps2: _Reals, known: int) -> int:
    """End of the samples once spikes are gone from the rows behind the known ones, in place: what is far from both neighbours.

    The last sample is judged by one neighbour alone; the very first one has none and stays.
    """

def longest_gap_ns(stamps_ns: _Indices, start_ns: int, end_ns: int) -> int:
    """The longest time between start and end, both included, without a sample."""

def is_steady(gyro_radps: _Reals, accel_mps2: _Reals, limits: tuple[float, float, float, float, float]) -> bool:
    """Whether means of tenths of a window agree, and are those of a body at rest or rolling evenly.

    limits: largest standard deviation of the means of gyro and of accel, largest mean of gyro, gravity and by how much it may be missed.
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
    """End of the latest steady window that begins at first_ns or later; a stamp before first_ns where there is none."""

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
    """The point (3,) of one track by least squares from a start (3,); NaN where it does not settle in front of every camera.

    views (n,): which of the cameras odom_from_cam (V, 4, 4) with lenses (V, 4) saw the pixels (n, 3).
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
    """Of a normal error's variance, what is left among those whose square stays below the limit."""

class Filter:
    """The right-invariant multi-state constraint filter. Errors: rotation, velocity, position, biases of gyro and accelerometer, time
    offset, then rotation and position of each clone; in true_error_cov four considered ones come first.

    true = Exp(error) * estimate, in `odom` axes. A clone_id that is not held is a ValueError.
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
        """Moves the state through inertial samples; the last angular rate (3,), bias removed. noise weighs, true_noise is real."""

    def predict_random_walk(
        self,
        body_from_next: _Reals,
        rotation_sigma_rad: float,
        translation_sigma_m: float,
        duration_s: float = 0.0,
        measured_cov: _Reals | None = None,
    ) -> None:
        """Moves the state by a relative transform that is known only to the sigmas.

        measured_cov (6, 6), in the next body's axes, rotation first, is added information where it is given.
        """

    def add_clone(self, clone_id: int, rate_body_radps: _Reals) -> None:
        """Keeps the current body transform in the window; the rate ties it to the time offset."""

    def remove_clone(self, clone_id: int) -> None:
        """Forgets a clone (marginalises it)."""

    def return_to_clone(self, clone_id: int) -> None:
        """Takes rotation and position of the state back to a clone's, as certain as that is."""

    def begin_frame_anew(self) -> _Reals:
        """new_odom_from_old_odom (4, 4): the frame now begins at the newest clone, and errors count from there.

        Motions between clones, and what is known of them, stay. Velocity and biases must be idle.
        """

    def observe(self, frame_index: int, camera: int, ids: _Indices, pixels: _Reals) -> None:
        """What one camera, counted from 0, saw in a frame: ids (N,), pixels (N, 3) u_left v u_right, NaN where that is unknown.

        Of use once a clone has the frame's index.
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
        """Uses each observation once, of tracks that ended, or are due, with two or more in the clones.

        alive (N,): ids that the newest frame saw, due (N,): which of them are to be used now. What is due but seen once stays; what ended
        so is forgotten. Returns for each track (T,), by rising ids: 1 taken, 0 not triangulated, -1 rejected by its gate.

        A point is looked for from its nearest view, by the disparity, or first_depth_m along the newest ray where no view has one.
        More than one iteration relinearises (iterated Kalman filter), for large corrections; newest_odom_from_body (4, 4) is then where
        the newest clone is linearised first, when vision knows it better than the prediction. It adds no information. sigma_scale
        widens the measurement noise, for matches that are less exact than flow.
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
        """Corrects by forward speed, none sideways and upwards, and yaw rate; squared Mahalanobis distance by true_error_cov.

        Nothing is changed where that exceeds the gate.
        """

    def correct_by_rest(self, gyro_mean_radps: _Reals, gyro_sigma_radps: float, gate: float) -> float:
        """Corrects by standing still: the gyro shows its bias alone. Otherwise as correct_by_wheels."""

    def inflate(self, clone_id: int, seen_odom_from_body: _Reals, gap_s: float) -> bool:
        """Inflates position and velocity where vision contradicts the prediction since a clone; True where it did.

        To be called before the clone of this moment is added.
        """

    def inflate_velocity(self, sigma_mps: float) -> None:
        """Adds the variance of an unknown change of velocity."""

    def motion_between(self, earlier_id: int, later_id: int) -> _Reals:
        """earlier_from_later (4, 4) between two clones."""

    def body_since(self, clone_id: int) -> _Reals:
        """earlier_from_now (4, 4) between a clone and the newest one."""

    def motion_since(self, clone_id: int) -> tuple[_Reals, _Reals]:
        """As body_since, and its covariance (6, 6), of a left perturbation in axes of the earlier body."""

    def cam_from_earlier(self, clone_id: int, cam_from_body: _Reals) -> _Reals:
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

    @property
    def covariance(self) -> _Reals:
        """What weighs and gates measurements; a copy."""

    @property
    def true_error_cov(self) -> _Reals:
        """That of the true error; a copy."""

    @property
    def offset_sigma_s(self) -> float:
        """Standard deviation of the time offset's true error."""
    imu_minus_cam_s: float

# --- the simulator's pictures (render.h), and rays against boxes (rays.h) ---

class ScenePainter:
    """Paints what one camera sees: plane (6,) fx fy cx cy width height, rays (H, W, 4) of a lens or none."""

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
        face_of: _Numbers,
    ) -> None:
        """Adds an instant to a picture (H, W): faces as of `Faces` with light and strengths of groups; textures as of `Atlas`."""

def develop(
    radiance: _Reals, gain: float, shot: float, read: float, normals: _Floats, key: int, vignetting: _Floats
) -> _Grey:
    """A picture (H, W) of grey levels with shot noise (variance per grey level) and read noise (standard deviation)."""

class BoxGrid:
    """Boxes (B, 8) as of `Faces` in a grid between two corners (3,)."""

    def __init__(self, boxes: _Reals, low: _Reals, high: _Reals, cell_m: float) -> None: ...
    def cast(self, origin: _Reals, directions: _Reals, farthest: _Reals) -> tuple[_Reals, _Indices]:
        """(N,) parameters of the nearest hits, up to farthest (N,), and (N, 2) box and side, -1 for none."""

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
        """Adds the lamps' (L, 5) direct light to light (groups, samples) of faces; their own boxes come owner_shift later."""
