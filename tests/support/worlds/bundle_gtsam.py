"""A bundle problem's images as a gtsam factor graph."""

import gtsam
import numpy as np

from mapserver.survey.bundle.problem import BundleProblem


def gtsam_graph(problem: BundleProblem, huber: float) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The same residuals, noise and Huber width, and the problem's values."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    focal, baseline = problem.rig.camera.focal_px, problem.rig.camera.baseline_m
    stereo_lens = gtsam.Cal3_S2Stereo(focal, focal, 0, problem.rig.camera.cx_px, problem.rig.camera.cy_px, baseline)
    lens = gtsam.Cal3_S2(focal, focal, 0, problem.rig.camera.cx_px, problem.rig.camera.cy_px)
    mount = gtsam.Pose3(problem.rig.body_from_cam[0])
    for k, map_from_body in enumerate(problem.map_from_body):
        values.insert(gtsam.symbol("x", k), gtsam.Pose3(map_from_body))
        if problem.fixed[k]:
            graph.add(gtsam.NonlinearEqualityPose3(gtsam.symbol("x", k), gtsam.Pose3(map_from_body)))
    for n in np.unique(problem.obs_landmark):
        values.insert(gtsam.symbol("l", int(n)), problem.points_map[n])
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(huber)
    rows = zip(problem.obs_keyframe, problem.obs_landmark, problem.obs_pixels, problem.obs_sigma_px, strict=True)
    for k, n, pixel, sigma in rows:
        x, point = gtsam.symbol("x", int(k)), gtsam.symbol("l", int(n))
        if np.isfinite(pixel[2]):
            along = sigma[0] ** 2
            cov = np.array([[along, along, 0], [along, along + sigma[1] ** 2, 0], [0, 0, sigma[0] ** 2]])
            noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Gaussian.Covariance(cov))
            measured = gtsam.StereoPoint2(pixel[0], pixel[2], pixel[1])
            graph.add(gtsam.GenericStereoFactor3D(measured, noise, x, point, stereo_lens, mount))
        else:
            noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, sigma[0]))
            graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel[:2], noise, x, point, lens, mount))
    return graph, values
