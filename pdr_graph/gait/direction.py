"""Which way the walker went, step by step."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from pdr_graph.inertial.attitude import Attitude
from pdr_graph.types import Array


def accumulate_turn(attitude: Attitude) -> Array:
    """Heading ``(n,)`` [rad] relative to the first sample, as the integral of the angular rate about gravity.

    [heading] Sec. 4.3, Eq. (1): θ_i = θ_{i-1} + ω_{z,i} ΔT_i. It does not matter how the phone is held.
    """
    assert attitude.angular_rate is not None, "there is a gyroscope"
    rate_z = attitude.R_world_device.apply(attitude.angular_rate)[:, 2]
    turned = np.cumsum(rate_z) * attitude.period
    return turned - turned[0]


def without_gait(heading: Array, samples_per_step: int) -> Array:
    """Heading without most of the sway of the gait, which the paper names as accumulation's defect.

    A centred mean over one step: it does not lag. What is left alternates from step to step and does not add up; a mean
    over a whole stride would remove that too, but cuts the corners of real turns.
    """
    return uniform_filter1d(heading, max(1, samples_per_step), mode="nearest")
