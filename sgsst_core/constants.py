"""Constants of the splatting model, each with the reason for its value.

They are those of gsplat 1.6 and of the method it implements, because a scene renders correctly only with the constants
it was trained with. Compiled kernels contain these values, so change them only here.
"""

from __future__ import annotations

import math

#: Real spherical harmonics in the order and with the signs of 3DGS files (Sloan, "Efficient Spherical Harmonic
#: Evaluation", JCGT 2013). Degree 0: 1 / (2 sqrt(pi)).
SH_C0 = 0.5 / math.sqrt(math.pi)
#: Degree 1: sqrt(3 / (4 pi)).
SH_C1 = math.sqrt(0.75 / math.pi)
#: Degree 2, in the order xy, yz, 2zz - xx - yy, xz, xx - yy.
SH_C2 = (
    math.sqrt(15.0 / math.pi) / 2,
    -math.sqrt(15.0 / math.pi) / 2,
    math.sqrt(5.0 / math.pi) / 4,
    -math.sqrt(15.0 / math.pi) / 2,
    math.sqrt(15.0 / math.pi) / 4,
)
#: Degree 3, in the order y(3xx - yy), xyz, y(4zz - xx - yy), z(2zz - 3xx - 3yy), x(4zz - xx - yy), z(xx - yy),
#: x(xx - 3yy).
SH_C3 = (
    -math.sqrt(17.5 / math.pi) / 4,
    math.sqrt(105.0 / math.pi) / 2,
    -math.sqrt(10.5 / math.pi) / 4,
    math.sqrt(7.0 / math.pi) / 4,
    -math.sqrt(10.5 / math.pi) / 4,
    math.sqrt(105.0 / math.pi) / 4,
    -math.sqrt(17.5 / math.pi) / 4,
)

#: Files store colors relative to mid-gray, so coefficients of zero are gray.
COLOR_OFFSET = 0.5

#: Variance in square pixels added to both axes of a projected Gaussian: the width of a pixel. Without it, a Gaussian
#: smaller than a pixel could fall between pixel centers.
EPS2D = 0.3

#: Upper limit of alpha: a Gaussian never hides everything behind it, so transmittance stays above zero. gsplat 1.6 and
#: the original use 0.99; gsplat 1.5.3, the version on PyPI, uses 0.999.
ALPHA_MAX = 0.99

#: Contributions below one gray level of an 8-bit image are skipped, which also gives a Gaussian finite support.
ALPHA_MIN = 1.0 / 255.0

#: A pixel is finished before its transmittance falls to this value, 1e-4: two opaque Gaussians. It is written as their
#: product, so that the second one finishes the pixel in float64 as it does in float32 (where 1e-4 itself would not).
TRANSMITTANCE_MIN = (1.0 - ALPHA_MAX) ** 2

#: Smallest depth that is drawn, in world units, as in the original viewers. gsplat trains with 0.01.
NEAR = 0.2

#: Limit of the directions at which the perspective is linearized, as a fraction of the half field of view beyond the
#: image border. Further out, linearizing would smear a distant Gaussian over the image.
FRUSTUM_MARGIN = 0.3

#: Edge of a raster tile in pixels. 16 neighboring pixels of a row fill one 512-bit or two 256-bit vectors.
RASTER_TILE = 16

#: Maximum shorter side of the coarsest scale, which is then in 256..511, about the size VGG was trained on (SGSST). If
#: full views are no larger than that, a smaller limit still gives them several scales.
COARSEST_SHORTER_SIDE = 511
