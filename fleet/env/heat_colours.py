"""The colour of a motor by its temperature: pale blue when cool, amber at the warning limit, red at the error limit.

The darker, the hotter, so the order can be told without colour vision. Colours are mixed in OKLab, where equal steps
look equal. Source: B. Ottosson, "A perceptual color space for image processing" (2020).
"""

import numpy as np

Array = np.ndarray

COOL_C = 20.0
BEYOND_K = 10.0
"""Above the error limit the scale goes on so far."""
COLOURS = ("#cbe2f4", "#efd382", "#e08a00", "#cc2222", "#4d0a2a")
"""Cool, halfway to the warning, warning, error, beyond. Warning and error as in the report."""

_TO_LMS = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_TO_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
_FROM_LMS, _FROM_LAB = np.linalg.inv(_TO_LMS), np.linalg.inv(_TO_LAB)


def marks_c(warning_c: float, error_c: float) -> tuple[float, float, float, float, float]:
    """Temperatures of `COLOURS`, °C, rising."""
    cool_c = min(COOL_C, warning_c - COOL_C)
    return cool_c, (cool_c + warning_c) / 2, warning_c, error_c, error_c + BEYOND_K


def heat_colour(temp_c: Array, warning_c: float, error_c: float) -> Array:
    """sRGB, uint8 [..., 3], of temperatures [...]; constant outside the scale."""
    temps = np.asarray(temp_c, dtype=float)
    lab = np.stack([np.interp(temps, marks_c(warning_c, error_c), _STOPS[:, i]) for i in range(3)], axis=-1)
    linear = np.clip((lab @ _FROM_LAB.T) ** 3 @ _FROM_LMS.T, 0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(srgb * 255).astype(np.uint8)


def rgb(colour: str) -> tuple[int, int, int]:
    """Of a colour like #aabbcc."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def _oklab(colour: str) -> Array:
    srgb = np.array(rgb(colour)) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return _TO_LAB @ np.cbrt(_TO_LMS @ linear)


_STOPS = np.stack([_oklab(colour) for colour in COLOURS])
