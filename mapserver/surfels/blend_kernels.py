"""Gaussians blended into a picture and the derivatives of a loss back to them. Source: Kerbl et al. 2023; Mip-Splatting, Yu et al. 2024."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import uncounted_kernel

LEAST_ALPHA = 1.0 / 255.0  # what covers less of a pixel is not drawn there
HIDDEN = 1e-4  # share of the light at which a pixel is full


@uncounted_kernel
def blend(
    pixels: Array, conics: Array, reaches_px: Array, peaks: Array, opacities: Array, greys: Array, blur_px2: float, slopes: Array,
    whole: Array, is_learning: bool, through: Array, picture: Array, gradients: Array,
) -> None:  # fmt: skip
    """Draws M Gaussians front to back, in their order; is_learning: fills gradients (M, 3) in a second pass over the same.

    pixels (M, 2) of their centres, conics (M, 3) xx, xy, yy of the inverse covariances, whose blur_px2 on the diagonal is the pixels'
    own, reaches_px (M, 2) beyond which LEAST_ALPHA is not reached. peaks (M,): alphas in the middle, of opacities (M,). through (H, W)
    comes as ones and is the share of light that passes all, picture (H, W) comes as zeros. Only where is_learning: whole (H, W), the
    picture of the first pass, slopes (H, W) of the loss by it, and gradients (M, 3) of the loss by grey, logarithm of the
    size and logit of the opacity, which come as zeros.
    """
    rows, columns = picture.shape
    for i in range(len(pixels)):
        u_px, v_px, xx, xy, yy = pixels[i, 0], pixels[i, 1], conics[i, 0], conics[i, 1], conics[i, 2]
        first_u, last_u = (
            max(0.0, np.ceil(u_px - reaches_px[i, 0])),
            min(columns - 1.0, np.floor(u_px + reaches_px[i, 0])),
        )
        first_v, last_v = max(0.0, np.ceil(v_px - reaches_px[i, 1])), min(rows - 1.0, np.floor(v_px + reaches_px[i, 1]))
        spread = blur_px2 * (xx + yy)
        by_grey, by_size, by_opacity = 0.0, 0.0, 0.0
        for v in range(int(first_v), int(last_v) + 1):
            for u in range(int(first_u), int(last_u) + 1):
                light = through[v, u]
                if light < HIDDEN:
                    continue
                du, dv = u - u_px, v - v_px
                qu, qv = xx * du + xy * dv, xy * du + yy * dv
                squared = du * qu + dv * qv
                alpha = peaks[i] * np.exp(-0.5 * squared)
                if alpha < LEAST_ALPHA:
                    continue
                picture[v, u] += light * alpha * greys[i]
                through[v, u] = light * (1.0 - alpha)
                if is_learning:
                    slope = slopes[v, u]
                    behind = whole[v, u] - picture[v, u]
                    by_alpha = slope * (light * greys[i] - behind / (1.0 - alpha)) * alpha
                    by_grey += slope * light * alpha
                    by_size += by_alpha * (squared - blur_px2 * (qu * qu + qv * qv) + spread)
                    by_opacity += by_alpha
        if is_learning:
            gradients[i, 0], gradients[i, 1] = by_grey, by_size
            gradients[i, 2] = by_opacity * (1.0 - opacities[i])
