"""How colours look to people: lightness, and as without one kind of cones."""

import numpy as np

# Deuteranopia, linear RGB to linear RGB: Viénot, Brettel & Mollon, Color Research and Application 1999
DEUTERANOPIA = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])  # of linear sRGB
WHITE = np.array([0.9505, 1.0, 1.089])


def rgb(colour):
    """The parts (3,), 0 to 255, of a colour such as #1f5fbf."""
    return np.array([int(colour[n : n + 2], 16) for n in (1, 3, 5)])


def lab(parts, seen_by=None):
    """CIE L*a*b* of a colour (3,), 0 to 255; seen_by: a matrix of a kind of colour blindness."""
    share = np.asarray(parts) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    x, y, z = XYZ @ np.clip(linear if seen_by is None else seen_by @ linear, 0, 1) / WHITE
    f = [value ** (1 / 3) if value > 0.008856 else 7.787 * value + 16 / 116 for value in (x, y, z)]
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def lightness(parts):
    """L* of a colour (3,): 0 black, 100 white, and all of it that a grey print shows."""
    return lab(parts)[0]
