"""What a plan depends on besides its arm and its work, without loading the physics."""

from importlib import resources

GRAVITY_M_S2 = 9.81
ELBOW_ANGLES_DEG = (0.0, 60.0, -60.0, 120.0, -120.0, 180.0, 30.0, -30.0, 90.0, -90.0, 150.0, -150.0)
"""Turns of the elbow about the line from shoulder to wrist, in the order in which they are tried; 0 is
furthest out along the base axis."""


def gen3_xml() -> bytes:
    """The project's MJCF of one Gen3."""
    return resources.files("fleet").joinpath("sim/assets/gen3.xml").read_bytes()
