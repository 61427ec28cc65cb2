"""Fixtures of the tiny world with two boxes."""

from tests.unit.two_boxes_world import two_boxes, two_boxes_contributions

__all__ = ["two_boxes", "two_boxes_contributions"]
