"""The 22 classes of Waymo's 3D semantic segmentation.

Source: waymo-research/waymo-open-dataset `protos/segmentation.proto`; 0 is undefined. The benchmark has no
text queries, so the queries are ours: the names in words, and "walkable ground" for TYPE_WALKABLE.
"""

from hilsplat.datasets.classes.class_set import ClassSet, words_of

_NAMES = """
    car, truck, bus, other vehicle, motorcyclist, bicyclist, pedestrian, sign, traffic light, pole,
    construction cone, bicycle, motorcycle, building, vegetation, tree trunk, curb, road, lane marker,
    other ground, walkable ground, sidewalk
"""

WAYMO_22 = ClassSet.of(
    "waymo-22", "Waymo Open Dataset; queries ours", dict(enumerate(words_of(_NAMES), start=1))
)
