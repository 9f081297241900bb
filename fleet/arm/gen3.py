"""Constants of the Gen3 model that plans depend on; importing them loads no physics."""

from importlib import resources

GRAVITY_M_S2 = 9.81
ELBOW_ANGLES_DEG = (0.0, 60.0, -60.0, 120.0, -120.0, 180.0, 30.0, -30.0, 90.0, -90.0, 150.0, -150.0)
"""Angles of the elbow about the line from shoulder to wrist, in the order in which the planner tries them; at 0 the
elbow is furthest along the base axis."""


def gen3_xml() -> bytes:
    """MJCF model of one Gen3."""
    return resources.files("fleet").joinpath("arm/assets/gen3.xml").read_bytes()
