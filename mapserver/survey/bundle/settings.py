"""Settings of bundle adjustment; apart from the code, so that reading a configuration compiles nothing."""

from math import inf

from fleetmap.config import Section


class BundleSettings(Section, frozen=True):
    """How hard bundle adjustment tries. Widths are in sigmas of an observation's residual."""

    max_iterations: int = 10  # Levenberg-Marquardt steps
    huber_sigmas: float = 2.5  # where the loss turns from quadratic to linear
    cutoff_sigmas: float = inf  # observations farther off have no influence
    lambda_start: float = 1e-4  # first damping
    relative_cost_tolerance: float = 1e-4  # relative gain of the last step
    dense_unknowns: int = 700  # reduced systems up to this size are solved by dense Cholesky
    # For each keyframe; up to so many sparse factorisation is quicker than conjugate gradients.
    sparse_couplings: float = 100.0
    pcg_tolerance: float = 1e-4  # relative residual at the end
    pcg_max_iterations: int = 300  # then the step is solved again by sparse factorisation
